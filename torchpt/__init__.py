"""torchpt: a wavefront path tracer that is a PyTorch program.

``torchpt.load`` a scene, ``torchpt.render`` it, ``torchpt.write_image`` the picture. Names are imported on first use,
so ``import torchpt`` is quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchpt.core.errors import (
    AssetError,
    EdgeWarning,
    EnergyWarning,
    ImportedSceneWarning,
    LostRankError,
    NoLightWarning,
    NotBuiltError,
    OtherRankError,
    OutputError,
    RenderError,
    SceneError,
    TorchptError,
)
from torchpt.core.version import __version__ as __version__

if TYPE_CHECKING:
    from torchpt import cameras, data, extend, ibl, losses, metrics, nn, ranks
    from torchpt.images import read_header, read_image, read_layers, write_image
    from torchpt.images.denoiser import denoise
    from torchpt.math.guiding import EdgeGuide
    from torchpt.physics.bsdfs import Bsdf
    from torchpt.rendering import Rendering
    from torchpt.rendering.api import render, trace
    from torchpt.rendering.batches import Renderings, render_batch
    from torchpt.rendering.estimates import GradientEstimate, gradient
    from torchpt.rendering.renderer import Renderer
    from torchpt.scene import Scene, load
    from torchpt.scene.from_trimesh import from_trimesh
    from torchpt.scene.prepare import empty_cache

__all__ = [
    "AssetError",
    "Bsdf",
    "EdgeGuide",
    "EdgeWarning",
    "EnergyWarning",
    "GradientEstimate",
    "ImportedSceneWarning",
    "LostRankError",
    "NoLightWarning",
    "NotBuiltError",
    "OtherRankError",
    "OutputError",
    "RenderError",
    "Renderer",
    "Rendering",
    "Renderings",
    "Scene",
    "SceneError",
    "TorchptError",
    "cameras",
    "data",
    "denoise",
    "empty_cache",
    "extend",
    "from_trimesh",
    "gradient",
    "ibl",
    "load",
    "losses",
    "metrics",
    "nn",
    "ranks",
    "read_header",
    "read_image",
    "read_layers",
    "render",
    "render_batch",
    "trace",
    "write_image",
]

# public name -> module that defines it
_LAZY_NAMES = {
    "Bsdf": "torchpt.physics.bsdfs",
    "EdgeGuide": "torchpt.math.guiding",
    "GradientEstimate": "torchpt.rendering.estimates",
    "Renderer": "torchpt.rendering.renderer",
    "Rendering": "torchpt.rendering",
    "Renderings": "torchpt.rendering.batches",
    "Scene": "torchpt.scene",
    "denoise": "torchpt.images.denoiser",
    "empty_cache": "torchpt.scene.prepare",
    "from_trimesh": "torchpt.scene.from_trimesh",
    "gradient": "torchpt.rendering.estimates",
    "load": "torchpt.scene",
    "read_header": "torchpt.images",
    "read_image": "torchpt.images",
    "read_layers": "torchpt.images",
    "render": "torchpt.rendering.api",
    "render_batch": "torchpt.rendering.batches",
    "trace": "torchpt.rendering.api",
    "write_image": "torchpt.images",
}

# public module -> its dotted name
_MODULES = {
    "cameras": "torchpt.cameras",
    "data": "torchpt.data",
    "extend": "torchpt.extend",
    "ibl": "torchpt.ibl",
    "losses": "torchpt.losses",
    "metrics": "torchpt.metrics",
    "nn": "torchpt.nn",
    "ranks": "torchpt.ranks",
}


# Python calls these two for names that the module does not have (yet), and for dir().


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _MODULES:
        return import_module(_MODULES[name])
    if name not in _LAZY_NAMES:
        raise AttributeError(f"module 'torchpt' has no attribute {name!r}")
    value = getattr(import_module(_LAZY_NAMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
