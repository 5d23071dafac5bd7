"""Small scenes for several topics."""

from __future__ import annotations

from typing import Any

__all__ = ["SKY", "ball", "facing", "floor_seen", "furnace", "room"]

#: Constant environment of radiance 1.
SKY = {"sky": {"type": "constant", "radiance": 1.0}}


def facing(width: float = 0.5, distance: float = 4.0) -> dict[str, Any]:
    """Return an orthographic camera that looks down the z axis."""
    return {"type": "orthographic", "origin": [0, 0, distance], "target": [0, 0, 0], "width": width}


def furnace(material: dict[str, Any], **shape: Any) -> dict[str, Any]:
    """Return a white furnace: a ball under a constant environment that fills the picture, which shows its albedo."""
    return {
        "camera": facing(1.0),
        "shapes": {"ball": {"type": "sphere", "material": material, **shape}},
        "lights": SKY,
    }


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), **keys: Any) -> dict[str, Any]:
    """Return a sphere."""
    return {"type": "sphere", "radius": radius, "center": list(centre), **keys}


def floor_seen(
    lights: dict[str, Any] | None, shapes: dict[str, Any] | None = None, albedo: float = 0.5, near: float = 1e-3
) -> dict[str, Any]:
    """Return a diffuse square in z = 0, seen from the side and so close that nothing above it is in the way."""
    return {
        "camera": {"type": "perspective", "origin": [near, 0, near], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 1e-3},
        "shapes": {
            "floor": {"type": "rectangle", "material": {"type": "diffuse", "reflectance": albedo}},
            **(shapes or {}),
        },
        **({"lights": lights} if lights else {}),
    }


def room(albedo: float, emission: float = 1.0) -> dict[str, Any]:
    """Return the inside of a sphere whose wall emits and reflects, seen from its centre."""
    return {
        "camera": {"type": "perspective", "origin": [0, 0, 0], "target": [0, 0, 1], "fov": 60},
        "shapes": {
            "wall": {
                "type": "sphere",
                "flip_normals": True,
                "emission": emission,
                "material": {"type": "diffuse", "reflectance": albedo},
            }
        },
    }
