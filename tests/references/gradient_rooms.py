"""A small room, and the gradient of a weighted sum of its picture."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from trials import film_of

import torchpt

__all__ = ["gradient_of", "room"]


def room(plate: dict[str, Any], shapes: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    """Return a quad of a material between two grey walls and a lamp."""
    wall = {"type": "rectangle", "material": "grey"}
    return {
        "camera": {"origin": [0.1, 0.2, 2], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 40},
        "film": {**film_of(12), "filter": "box"},
        "integrator": {"type": "path", "max_depth": 5},
        "materials": {"plate": plate, "grey": {"type": "diffuse", "reflectance": [0.8, 0.6, 0.4]}},
        "shapes": {
            "plate": {"type": "rectangle", "material": "plate", "transform": [{"scale": 0.8}]},
            "behind": {**wall, "transform": [{"scale": 6}, {"translate": [0, 0, -2]}]},
            "before": {
                **wall,
                "transform": [{"scale": 6}, {"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 0, 5]}],
            },
            "lamp": {
                "type": "mesh",
                "face_normals": True,
                "vertices": [[1, 1, 3], [1.6, 1, 3], [1, 1.8, 3.1]],
                "faces": [[0, 2, 1]],
                "emission": [9, 7, 5],
            },
            **(shapes or {}),
        },
        **more,
    }


def gradient_of(scene: torchpt.Scene, name: str, **wish: Any) -> Tensor:
    """Return the gradient of a weighted sum of the picture by a parameter, with fixed samples, in float64."""
    wish = {"spp": 4, "seed": 3, "seed_grad": 3, "threads": 1, **wish}
    leaf = scene.params[name].clone().requires_grad_()
    image = torchpt.render(scene, params={name: leaf}, **wish)
    weight = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
    (found,) = torch.autograd.grad((image * weight).sum(), leaf)
    return found.double()
