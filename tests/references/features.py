"""A plain scene, and the same scene with one more feature, to compare their costs."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torchpt
from torchpt.engines.kernels.programs import Kernels
from torchpt.rendering import scene_cache

__all__ = ["FEATURES", "PLAIN", "Feature", "kernels", "with_feature"]

_SCENES = Path(__file__).parents[2] / "scenes"
_TURN = {"rotate": {"axis": [1, 0, 0], "angle": -90}}

PLAIN: dict[str, Any] = {
    "camera": {"origin": [0, 1.5, 4], "target": [0, 0.5, 0], "fov": 45},
    "materials": {"clay": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.3]}},
    "shapes": {
        "floor": {"type": "rectangle", "material": "clay", "transform": [{"scale": 3}, _TURN]},
        "wall": {
            "type": "rectangle",
            "material": "clay",
            "transform": [{"scale": 3}, {"translate": [0, 0, -2]}],
        },
        "lamp": {
            "type": "rectangle",
            "emission": 8,
            "material": "clay",
            "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 3, 0]}],
        },
    },
    "integrator": {"type": "path", "max_depth": 4, "rr_depth": 9},
    "film": {"width": 64, "height": 64, "filter": "box"},
}


@dataclass(frozen=True)
class Feature:
    """A feature that a scene may use.

    Attributes:
        files: files of the package that only this feature needs, relative to it.
        add: function that adds the feature to a scene.
        leaves: prefixes of the names of its tables.
        rows: fields that it adds to the path state.
        module: module that a scene without it does not import; None if such modules are always imported together.
    """

    files: tuple[str, ...]
    add: Callable[[dict[str, Any]], None]
    leaves: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    module: str | None = None


def _material(scene: dict[str, Any], **keys: Any) -> None:
    scene["materials"]["more"] = {"type": "diffuse", **keys}
    scene["shapes"]["wall"]["material"] = "more"


def _squares(**keys: Any) -> dict[str, Any]:
    return {"type": "checkerboard", "scale": 6, **keys}


def _light(scene: dict[str, Any], **keys: Any) -> None:
    scene["lights"] = {"more": keys}


#: By name.
FEATURES: dict[str, Feature] = {
    "second material": Feature(
        ("physics/bsdfs/kinds/roughconductor.py",),
        lambda scene: _material(scene, **{"type": "roughconductor", "material": "Au", "alpha": 0.2}),
        ("world.materials.parameters.1",),
        module="torchpt.physics.bsdfs.kinds.roughconductor",
    ),
    "refraction": Feature(
        ("physics/bsdfs/kinds/dielectric.py", "physics/bsdfs/lobes.py"),
        lambda scene: _material(scene, type="dielectric"),
        ("world.materials.parameters.1",),
        ("eta",),
        module="torchpt.physics.bsdfs.kinds.dielectric",
    ),
    "texture": Feature(
        ("physics/textures/atlas.py",),
        lambda scene: _material(scene, reflectance=_squares()),
        ("world.textures.tables", "world.geometry.uvs"),
        module="torchpt.physics.textures.atlas",
    ),
    "noise": Feature(
        ("physics/textures/kinds/noise.py", "physics/textures/computed.py"),
        lambda scene: _material(scene, reflectance={"type": "noise", "color0": 0.2, "color1": 0.8, "octaves": 2}),
        ("world.textures.tables", "world.geometry.uvs"),
        module="torchpt.physics.textures.kinds.noise",
    ),
    "normal map": Feature(
        ("paths/perturbed_normals.py",),
        lambda scene: _material(scene, normal_map=_squares(color0=[0.6, 0.45, 0.95], color1=[0.4, 0.5, 0.95])),
        ("world.textures.tables", "world.geometry.tangents"),
    ),
    "opacity": Feature(
        ("paths/transmission.py",), lambda scene: _material(scene, opacity=0.5), ("world.materials.opacity",),
        ("transmittance",),
    ),
    "constant sky": Feature(
        ("physics/lights/kinds/constant.py",),
        lambda scene: _light(scene, type="constant", radiance=0.3),
        ("world.lights.environment",),
        module="torchpt.physics.lights.kinds.constant",
    ),
    "environment map": Feature(
        ("physics/lights/kinds/envmap.py",),
        lambda scene: _light(scene, type="envmap", path=str(_SCENES / "sky.exr")),
        ("world.lights.environment",),
        module="torchpt.physics.lights.kinds.envmap",
    ),
    "sky and sun": Feature(
        ("physics/lights/kinds/sky.py", "physics/lights/hosek_wilkie.py"),
        lambda scene: _light(scene, type="sky", sun_direction=[1, 1, 1]),
        ("world.lights.environment",),
        module="torchpt.physics.lights.kinds.sky",
    ),
    "point light": Feature(
        ("physics/lights/kinds/point.py",),
        lambda scene: _light(scene, type="point", position=[1, 2, 1], intensity=5),
        module="torchpt.physics.lights.kinds.point",
    ),
    "directional light": Feature(
        ("physics/lights/kinds/directional.py",),
        lambda scene: _light(scene, type="directional", direction=[1, -2, 1], irradiance=2),
        module="torchpt.physics.lights.kinds.directional",
    ),
    "round lamp": Feature(
        ("physics/lights/surfaces/sphere.py",),
        lambda scene: scene["shapes"].update(bulb={"type": "sphere", "center": [1, 1, 0], "radius": 0.2, "emission": 3}),
        module="torchpt.physics.lights.surfaces.sphere",
    ),
    "sphere": Feature(
        ("physics/shapes/primitives/sphere.py",),
        lambda scene: scene["shapes"].update(more={"type": "sphere", "radius": 0.4, "material": "clay"}),
        ("world.geometry.flip",),
        module="torchpt.physics.shapes.primitives.sphere",
    ),
    "quadric": Feature(
        ("physics/shapes/primitives/quadric.py", "physics/shapes/quadrics.py", "physics/shapes/kinds/cylinder.py"),
        lambda scene: scene["shapes"].update(more={"type": "cylinder", "radius": 0.4, "capped": False, "material": "clay"}),
        ("world.geometry.quadrics",),
        module="torchpt.physics.shapes.kinds.cylinder",
    ),
    "layer": Feature(
        ("paths/layers.py",),
        lambda scene: scene["film"].update(aovs=["normal"]),
    ),
    "lens": Feature(
        ("physics/cameras/kinds/thinlens.py",),
        lambda scene: scene["camera"].update(type="thinlens", aperture_radius=0.05, focus_distance=4),
        ("camera.aperture", "camera.lens"),
        module="torchpt.physics.cameras.kinds.thinlens",
    ),
    "preview": Feature(
        ("paths/integrators/kinds/ibl.py", "paths/integrators/split_sum.py"),
        lambda scene: scene.update(integrator={"type": "ibl"}, lights={"more": {"type": "constant", "radiance": 0.3}}),
        ("first",),
        module="torchpt.paths.integrators.kinds.ibl",
    ),
    "roulette": Feature(("paths/roulette.py",), lambda scene: scene["integrator"].update(rr_depth=2)),
}  # fmt: skip


def with_feature(name: str | None) -> dict[str, Any]:
    """Return the plain scene, with a feature if a name is given."""
    scene = copy.deepcopy(PLAIN)
    if name is not None:
        FEATURES[name].add(scene)
    return scene


def kernels(described: Mapping[str, Any]) -> tuple[Kernels, torchpt.Scene]:
    """Build and return all kernels that a render of a scene needs."""
    scene = torchpt.load(described, "cpu")
    torchpt.render(scene, spp=8, compile="on", full=True)  # with the layers of the scene file
    made = scene_cache(scene).kernels
    assert made is not None
    return made, scene
