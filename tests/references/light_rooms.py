"""Rooms with all kinds of lights, materials and cameras, for tests of light paths."""

from __future__ import annotations

import math
from typing import Any

import torch

__all__ = ["ROOMS", "room"]


def _turned(angle: float, size: float, at: list[float], axis: list[int]) -> list[dict[str, Any]]:
    return [{"scale": size}, {"rotate": {"axis": axis, "angle": angle}}, {"translate": at}]


def _numbers(seed: int, *shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def _relief() -> list[Any]:
    """Return the colours of a normal map."""
    slopes = torch.randn(8, 8, 2, generator=torch.Generator().manual_seed(3)) * 0.5
    normals = torch.nn.functional.normalize(torch.cat((slopes, torch.ones(8, 8, 1)), -1), dim=-1)
    return (0.5 * normals + 0.5).tolist()


def _bumpy_ball(center: tuple[float, float, float], material: str) -> dict[str, Any]:
    """Return a ball of few faces, shaded smooth."""
    around, down = 10, 6
    vertices, faces = [], []
    for i in range(down + 1):
        theta = math.pi * (i + 0.001) / (down + 0.002)
        for j in range(around):
            phi = 2.0 * math.pi * j / around
            n = math.sin(theta) * math.cos(phi), math.cos(theta), math.sin(theta) * math.sin(phi)
            vertices.append([c + 0.4 * x for c, x in zip(center, n, strict=True)])
    for i in range(down):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            faces += [[a, b, b + around], [a, b + around, a + around]]
    return {"type": "mesh", "vertices": vertices, "faces": faces, "material": material}


def room(**changes: Any) -> dict[str, Any]:
    """Return a room without a lamp; blocks of ``changes`` are added to its own, camera and film take their place."""
    scene: dict[str, Any] = {
        "camera": {"type": "perspective", "origin": [0.3, 1.1, 3.6], "target": [0, 0.75, 0], "fov": 42},
        "film": {"width": 16, "height": 16, "filter": "box"},
        "integrator": {"max_depth": 7},
        "materials": {
            "grey": {"type": "diffuse", "reflectance": [0.7, 0.68, 0.66]},
            "ochre": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.1]},
            "blue": {"type": "diffuse", "reflectance": [0.1, 0.2, 0.6]},
            "metal": {"type": "roughconductor", "alpha": 0.2, "material": "Cu"},
            "glass": {"type": "roughdielectric", "int_ior": 1.5, "alpha": 0.2},
            "plastic": {"type": "roughplastic", "diffuse_reflectance": [0.3, 0.5, 0.2], "alpha": 0.2},
        },
        "shapes": {
            "floor": {"type": "rectangle", "material": "grey", "transform": _turned(-90, 1.5, [0, 0, 0], [1, 0, 0])},
            "back": {
                "type": "rectangle",
                "material": "ochre",
                "transform": [{"scale": 1.5}, {"translate": [0, 1, -1]}],
            },
            "left": {"type": "rectangle", "material": "blue", "transform": _turned(90, 1.0, [-1, 1, 0], [0, 1, 0])},
            "block": {
                "type": "cube",
                "material": "metal",
                "transform": _turned(20, 0.25, [-0.4, 0.25, -0.3], [0, 1, 0]),
            },
            "ball": {"type": "sphere", "center": [0.4, 0.4, 0.2], "radius": 0.35, "material": "glass"},
            "ball2": {"type": "sphere", "center": [-0.4, 0.25, 0.5], "radius": 0.25, "material": "plastic"},
        },
        "lights": {},
    }
    for key, value in changes.items():
        scene[key] = {**scene[key], **value} if key in ("materials", "shapes", "lights") else value
    return scene


LAMP: dict[str, Any] = {
    "type": "rectangle",
    "material": "grey",
    "emission": [8, 7, 6],
    "transform": _turned(90, 0.4, [0, 1.9, 0], [1, 0, 0]),
}
_LIT = {"lamp": LAMP}
_SUN = {"type": "directional", "direction": [-0.4, -1, -0.5], "irradiance": [1, 0.8, 0.7]}
_SPOT = {"type": "spot", "position": [-0.6, 1.8, 1], "target": [0, 0, 0], "intensity": [5, 5, 9], "cutoff_angle": 35}
_POINT = {"type": "point", "position": [0.5, 1.6, 0.6], "intensity": [2, 2, 1]}
_SHAPED = {
    "ball_lamp": {"type": "sphere", "center": [0.7, 1.5, 0.3], "radius": 0.12, "emission": [9, 8, 7]},
    "disk_lamp": {"type": "disk", "emission": [5, 9, 5], "transform": _turned(80, 0.2, [-0.5, 1.7, 0.3], [1, 0, 0])},
    "tube": {"type": "cylinder", "center": [0, 1.6, -0.5], "radius": 0.06, "height": 0.5, "emission": [4, 4, 9]},
    "cone": {"type": "cone", "apex": [0.2, 1.9, 0.6], "height": 0.3, "slope": 0.5, "emission": [6, 3, 3]},
    "flag": {
        "type": "mesh",
        "vertices": [[0.5, 0.05, 0.9], [0.8, 0.05, 0.9], [0.6, 0.3, 0.7]],
        "faces": [[0, 1, 2]],
        "emission": [9, 2, 2],
    },
}
_MANY = {
    f"lamp{k}": {
        "type": "sphere",
        "center": [-0.8 + 0.2 * k, 1.5 + 0.03 * (k % 3), 0.2 * (k % 4) - 0.3],
        "radius": 0.04,
        "emission": [30 + 5 * k, 20, 40 - 3 * k],
    }
    for k in range(9)
}
_GLOWING = {
    "type": "rectangle",
    "transform": LAMP["transform"],
    "material": {
        "type": "diffuse",
        "emission": {"type": "image", "data": (14 * _numbers(2, 4, 4, 3)).tolist()},
        "opacity": 0.7,
    },
}

#: Rooms by what they try.
ROOMS: dict[str, dict[str, Any]] = {
    "lights without extent": room(lights={"point": _POINT, "spot": _SPOT, "sun": _SUN}),
    "sky of one colour": room(lights={"sky": {"type": "constant", "radiance": [0.5, 0.6, 0.7]}}, shapes=_LIT),
    "sky and sun": room(
        lights={"sky": {"type": "sky", "sun_direction": [0.4, 0.6, 0.5], "sky_scale": 0.05, "sun_scale": 0.001}}
    ),
    "environment map": room(
        lights={"sky": {"type": "envmap", "data": (6 * _numbers(1, 8, 16, 3) ** 6).tolist()}},
    ),
    "lamps of all shapes": room(shapes=_SHAPED),
    "many lamps": room(
        shapes=_MANY,
        lights={
            "point": {**_POINT, "intensity": 0.3},
            "sky": {"type": "constant", "radiance": 0.1},
        },
    ),
    "textured lamp and opacity": room(
        materials={
            "veil": {"type": "diffuse", "reflectance": 0.6, "opacity": 0.5},
            "nothing": {"type": "null"},
        },
        shapes={
            "lamp": _GLOWING,
            "screen": {
                "type": "rectangle",
                "material": "veil",
                "transform": _turned(90, 0.5, [0.1, 1.4, 0.2], [1, 0, 0]),
            },
            "air": {"type": "sphere", "center": [0, 0.8, 0.4], "radius": 0.3, "material": "nothing"},
        },
    ),
    "thin lens": room(
        camera={
            "type": "thinlens",
            "origin": [0.3, 1.1, 3.6],
            "target": [0, 0.75, 0],
            "fov": 42,
            "aperture_radius": 0.12,
            "focus_distance": 3.0,
            "blades": 5,
        },
        film={"width": 16, "height": 16, "filter": "gaussian"},
        shapes=_LIT,
    ),
    "parallel rays": room(
        camera={"type": "orthographic", "origin": [0.3, 1.1, 3.6], "target": [0, 0.75, 0], "width": 2.5},
        film={"width": 16, "height": 16, "filter": "mitchell"},
        shapes=_LIT,
    ),
    "normal and bump maps": room(
        materials={
            "grey": {"type": "diffuse", "reflectance": 0.7, "normal_map": {"type": "image", "data": _relief()}},
            "ochre": {
                "type": "roughconductor",
                "alpha": 0.3,
                "reflectance": [0.8, 0.6, 0.3],
                "bump_map": {"type": "image", "data": (0.2 * _numbers(4, 8, 8)).tolist()},
            },
            "blue": {
                "type": "conductor",
                "reflectance": [0.5, 0.6, 0.9],
                "normal_map": {"type": "image", "data": _relief()},
            },
        },
        shapes=_LIT,
    ),
    "smooth normals": room(
        materials={"clear": {"type": "dielectric"}},
        shapes={
            **_LIT,
            "ball": _bumpy_ball((0.45, 0.42, 0.2), "clear"),
            "ball2": _bumpy_ball((-0.45, 0.42, 0.6), "grey"),
        },
    ),
    "layered materials": room(
        materials={
            "grey": {
                "type": "principled",
                "base_color": [0.7, 0.5, 0.4],
                "roughness": 0.4,
                "metallic": 0.3,
                "clearcoat": 0.5,
            },
            "ochre": {
                "type": "blend",
                "a": {"type": "conductor", "material": "Al"},
                "b": {"type": "diffuse"},
                "weight": 0.6,
            },
            "blue": {"type": "phong", "diffuse": 0.3, "specular": 0.4, "exponent": 30},
            "metal": {"type": "plastic", "diffuse_reflectance": [0.3, 0.2, 0.5]},
            "glass": {
                "type": "principled",
                "base_color": [0.9, 0.8, 0.9],
                "spec_trans": 0.8,
                "roughness": 0.3,
                "eta": 1.5,
            },
            "plastic": {"type": "thindielectric"},
        },
        shapes=_LIT,
    ),
    "one side": room(
        materials={
            "grey": {"type": "diffuse", "two_sided": False, "reflectance": 0.7},
            "metal": {"type": "roughconductor", "material": "Au", "alpha": 0.3, "two_sided": False},
        },
        shapes={
            **_LIT,
            "slab": {
                "type": "rectangle",
                "material": "grey",
                "transform": _turned(60, 0.4, [0.3, 1.2, 0.4], [1, 0, 0]),
            },
        },
    ),
}
