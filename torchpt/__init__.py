"""torchpt: a wavefront path tracer that is a PyTorch program.

``torchpt.load`` a scene, ``torchpt.render`` it, ``torchpt.write_image`` the picture. Names are resolved on first use,
so ``import torchpt`` itself is quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchpt.errors import (
    AssetError,
    EdgeWarning,
    EnergyWarning,
    LostRankError,
    NoLightWarning,
    NotBuiltError,
    OtherRankError,
    OutputError,
    RenderError,
    SceneError,
    TorchptError,
)

if TYPE_CHECKING:
    from torchpt import cameras, data, ibl, losses, nn, ranks
    from torchpt.batches import Renderings, render_batch
    from torchpt.bsdfs import Bsdf
    from torchpt.forward import Rendering
    from torchpt.images import metrics, read_header, read_image, read_layers, write_image
    from torchpt.images.denoiser import denoise
    from torchpt.rendering import render, trace
    from torchpt.scene import Scene, load
    from torchpt.scene.from_trimesh import from_trimesh

__version__ = "0.1.0"
__all__ = [
    "AssetError",
    "Bsdf",
    "EdgeWarning",
    "EnergyWarning",
    "LostRankError",
    "NoLightWarning",
    "NotBuiltError",
    "OtherRankError",
    "OutputError",
    "RenderError",
    "Rendering",
    "Renderings",
    "Scene",
    "SceneError",
    "TorchptError",
    "cameras",
    "data",
    "denoise",
    "from_trimesh",
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

# public name -> the module that has it
_LAZY = {
    "Bsdf": "torchpt.bsdfs",
    "Rendering": "torchpt.forward",
    "Renderings": "torchpt.batches",
    "Scene": "torchpt.scene",
    "denoise": "torchpt.images.denoiser",
    "from_trimesh": "torchpt.scene.from_trimesh",
    "load": "torchpt.scene",
    "read_header": "torchpt.images",
    "read_image": "torchpt.images",
    "read_layers": "torchpt.images",
    "render": "torchpt.rendering",
    "render_batch": "torchpt.batches",
    "trace": "torchpt.rendering",
    "write_image": "torchpt.images",
}

#: Public modules.
_MODULES = {
    "cameras": "torchpt.cameras",
    "data": "torchpt.data",
    "ibl": "torchpt.ibl",
    "losses": "torchpt.losses",
    "metrics": "torchpt.images.metrics",
    "nn": "torchpt.nn",
    "ranks": "torchpt.ranks",
}


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _MODULES:
        return import_module(_MODULES[name])
    if name not in _LAZY:
        raise AttributeError(f"module 'torchpt' has no attribute {name!r}")
    value = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
