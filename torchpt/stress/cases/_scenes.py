"""Small scenes that several topics use, as mappings with the keys of a scene file. Spheres have radius 1 by default."""

from __future__ import annotations

from typing import Any

__all__ = ["UNIT_SKY", "ball", "floor_seen", "front_camera", "furnace", "room"]

#: Constant environment of radiance 1.
UNIT_SKY = {"sky": {"type": "constant", "radiance": 1.0}}


def front_camera(*, width: float = 0.5, distance: float = 4.0) -> dict[str, Any]:
    """Return an orthographic camera at z = ``distance`` that looks down the z axis, ``width`` wide in the scene."""
    return {"type": "orthographic", "origin": [0, 0, distance], "target": [0, 0, 0], "width": width}


def furnace(material: dict[str, Any], **shape: Any) -> dict[str, Any]:
    """Return a white furnace: a ball under a constant environment. The ball fills the picture, which shows its albedo.

    Args:
        material: material of the ball.
        shape: further keys of the ball.
    """
    return {
        "camera": front_camera(width=1.0),
        "shapes": {"ball": {"type": "sphere", "material": material, **shape}},
        "lights": UNIT_SKY,
    }


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), **keys: Any) -> dict[str, Any]:
    """Return a sphere with further ``keys``."""
    return {"type": "sphere", "radius": radius, "center": list(centre), **keys}


def floor_seen(
    lights: dict[str, Any] | None,
    shapes: dict[str, Any] | None = None,
    *,
    albedo: float = 0.5,
    camera_height: float = 1e-3,
) -> dict[str, Any]:
    """Return a diffuse square in z = 0, seen at its centre under 45 degrees, from so close that nothing above is in the way.

    Args:
        lights: lights of the scene.
        shapes: further shapes.
        albedo: reflectance of the square.
        camera_height: height of the camera above the square; less than that of any other shape.
    """
    return {
        "camera": {
            "type": "perspective",
            "origin": [camera_height, 0, camera_height],
            "target": [0, 0, 0],
            "up": [0, 0, 1],
            "fov": 1e-3,
        },
        "shapes": {
            "floor": {"type": "rectangle", "material": {"type": "diffuse", "reflectance": albedo}},
            **(shapes or {}),
        },
        **({"lights": lights} if lights else {}),
    }


def room(albedo: float, emission: float = 1.0) -> dict[str, Any]:
    """Return the inside of a sphere whose wall emits and reflects, seen from its centre.

    Each bounce multiplies the radiance by the albedo: paths of up to n edges bring ``emission (1 - albedo^n) / (1 - albedo)``.
    """
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
