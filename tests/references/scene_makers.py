"""Scenes that tests share; those by index are in a module so that spawned workers can import them."""

from __future__ import annotations

from typing import Any

import torch

FILM = {"width": 10, "height": 8, "filter": "box"}


def room(index: int) -> dict[str, Any]:
    """Return a wall whose colour depends on the index, a ball in front of it, and a lamp."""
    colour = torch.rand(3, generator=torch.Generator().manual_seed(index)).tolist()
    return {
        "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
        "film": FILM,
        "integrator": {"type": "path", "max_depth": 3},
        "materials": {"wall": {"type": "diffuse", "reflectance": colour}},
        "shapes": {
            "back": {"type": "rectangle", "material": "wall", "transform": [{"scale": 2}]},
            "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.5},
            "lamp": {
                "type": "rectangle",
                "emission": 5,
                "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 2, 1]}],
            },
        },
    }


def dim(index: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the scene of :func:`room` with settings of its own."""
    return room(index), {"spp": 2, "params": {"shapes.lamp.emission": [1.0, 1.0, 1.0]}}


def flat(index: int) -> dict[str, Any]:
    """Return the scene of :func:`room` with an orthographic camera, which has no matrix K."""
    return {**room(index), "camera": {"type": "orthographic", "origin": [0, 0, 4], "target": [0, 0, 0], "width": 3}}


def lit_floor(**shapes: dict[str, Any]) -> dict[str, Any]:
    """Return a floor under a lamp, with more shapes, of the materials ``grey`` and ``film``, which lets light pass."""
    return {
        "camera": {"type": "perspective", "origin": [0, 1.2, 4], "target": [0, 0.6, 0], "fov": 40},
        "materials": {
            "grey": {"type": "diffuse", "reflectance": 0.6},
            "film": {"type": "diffuse", "reflectance": [0.7, 0.4, 0.3], "opacity": 0.4},
            "lamp": {"type": "diffuse", "reflectance": 0.0, "emission": 9.0},
        },
        "shapes": {
            "floor": turned("grey", -90.0, 2.0, [0, 0, 0]),
            "lamp": turned("lamp", 90.0, 0.4, [0, 2, 0]),
            **shapes,
        },
    }


def turned(material: str, angle: float, size: float, at: list[float]) -> dict[str, Any]:
    """Return a square turned about x."""
    turn = {"rotate": {"axis": [1, 0, 0], "angle": angle}}
    return {"type": "rectangle", "material": material, "transform": [{"scale": size}, turn, {"translate": at}]}
