"""Small rooms, and gradients of a weighted sum of their pictures."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from trials import film_of

import torchpt
from torchpt.gradients.parameters import SceneTape
from torchpt.math.sums import GradientSums

__all__ = ["gradient_of", "room", "several", "sums_of"]


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


PLATE = {"type": "roughconductor", "alpha": 0.3, "eta": [0.2, 0.4, 1.4], "k": [3, 2, 1.7]}
GLASS = {"type": "sphere", "center": [0.2, 0.1, 0.6], "radius": 0.3, "material": "glass"}
SKY = {"type": "constant", "radiance": [0.3, 0.2, 0.1]}


def several(opacity: float = 1.0) -> torchpt.Scene:
    """Three models, so that places of lanes are not in the order of their samples."""
    described = room({**PLATE, "opacity": opacity}, {"ball": GLASS}, lights={"sky": SKY})
    described["materials"]["glass"] = {"type": "dielectric", "int_ior": 1.4}
    return torchpt.load(described, "cpu")


def sums_of(scene: torchpt.Scene, *names: str, **wish: Any) -> Tensor:
    """The sums of gradients before they are rounded to float32, which would hide their order.

    So would terms of one size, which float64 adds exactly: those of pixels differ by up to 12 orders of magnitude.
    """
    found: list[Tensor] = []
    gradients = SceneTape.gradients

    def noted(self: SceneTape, whole: GradientSums) -> Any:
        found.extend(whole.total(number).flatten() for number in range(len(self.leaves)))
        return gradients(self, whole)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SceneTape, "gradients", noted)
        leaves = {name: scene.params[name].clone().requires_grad_() for name in names}
        wish = {"spp": 16, "seed": 3, "threads": 1, "edges": False, **wish}
        picture = torchpt.render(scene, params=leaves, **wish)
        weight = 10.0 ** (-12 * torch.rand(picture.shape, generator=torch.Generator().manual_seed(1)))
        torch.autograd.grad((picture * weight).sum(), list(leaves.values()))
    total = torch.cat(found)
    assert total.dtype == torch.float64 and float(total.norm()) > 0
    return total
