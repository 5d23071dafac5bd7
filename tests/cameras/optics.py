"""Cameras of every kind, and what their rays are made of."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.physics.cameras import Camera
from torchpt.scene.formats.description import settings

POSE = {"origin": [0.3, 1.1, 5], "target": [-0.2, 0.4, 0.1], "up": [0.1, 1, 0]}
LENS = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 4.2, "fov": 35}
#: What the tests of this folder look through; among them every kind, with every parameter that has a tensor.
CAMERAS: dict[str, dict[str, Any]] = {
    "perspective": {"type": "perspective", "fov": 35},
    "shifted": {
        "type": "perspective",
        "fov": 35,
        "fov_axis": "larger",
        "principal_point_offset_x": 0.1,
        "principal_point_offset_y": -0.2,
        "pixel_aspect": 1.3,
    },
    "thinlens": LENS,
    "hexagon": {**LENS, "blades": 6},
    "shifted lens": {
        **LENS,
        "fov_axis": "diagonal",
        "principal_point_offset_x": -0.1,
        "principal_point_offset_y": 0.1,
        "pixel_aspect": 0.8,
    },
    "orthographic": {"type": "orthographic", "width": 3.5},
}


def made(camera: dict[str, Any], width: int = 8, height: int = 6, dtype: torch.dtype = torch.float64) -> Camera:
    """The camera of an empty scene."""
    scene = torchpt.load({"camera": {**POSE, **camera}}, "cpu")
    film = settings(scene.description, {"film": {"width": width, "height": height}}).film
    exact = {name: torch.as_tensor(value) for name, value in scene.built.parameters.items()}  # params are float32
    return scene.camera(film, exact, dtype)


def numbers(rows: int, count: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """``(rows, count)`` in [0, 1)."""
    return torch.rand(rows, count, generator=torch.Generator().manual_seed(seed), dtype=dtype)
