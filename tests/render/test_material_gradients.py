"""Gradients through materials: parameters of every model, and geometry seen in mirrors and through glass."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from trials import film_of

import torchpt

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")

GOLD = {"type": "conductor", "eta": [0.2, 0.4, 1.4], "k": [3.2, 2.4, 1.7]}
GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
# A large plate before the camera; a lamp of small extent lights the wall beyond it, or the one behind the camera.
TURN = [{"rotate": {"axis": [0.3, 1, 0.1], "angle": 8}}]


def room(plate: dict[str, Any], integrator: dict[str, Any]) -> dict[str, Any]:
    wall = {"type": "rectangle", "material": "grey"}
    return {
        "camera": {"origin": [0.1, 0.2, 2], "target": [0, 0, 0], "fov": 20},
        "film": {**film_of(4), "filter": "box"},
        "integrator": {"type": "path", "rr_depth": 100, **integrator},
        "render": {"threads": 1},
        "materials": {"plate": plate, "grey": {"type": "diffuse", "reflectance": [0.8, 0.6, 0.4]}},
        "shapes": {
            "plate": {"type": "rectangle", "material": "plate", "transform": [{"scale": 3}, *TURN]},
            "behind": {**wall, "transform": [{"scale": 20}, {"translate": [0, 0, -3]}]},
            "before": {
                **wall,
                "transform": [{"scale": 20}, {"rotate": {"axis": [0, 1, 0], "angle": 180}}, {"translate": [0, 0, 5]}],
            },
            "lamp": {
                "type": "mesh",
                "face_normals": True,
                "vertices": [[1, 1, 3], [1.3, 1, 3], [1, 1.4, 3.1]],
                "faces": [[0, 1, 2]],
                "emission": [9, 7, 5],
            },
            "bulb": {
                "type": "mesh",
                "face_normals": True,
                "vertices": [[1, 1, -1], [1, 1.4, -1.1], [1.3, 1, -1]],
                "faces": [[0, 1, 2]],
                "emission": [5, 7, 9],
            },
        },
    }


def checked(scene: torchpt.Scene, *names: str) -> None:
    """gradcheck in float64, the backward pass drawing the samples of the forward pass."""
    leaves = tuple(scene.params[name].double().requires_grad_() for name in names)

    def picture(*tensors: torch.Tensor) -> torch.Tensor:
        given = dict(zip(names, tensors, strict=True))
        return torchpt.render(scene, params=given, spp=2, seed=3, seed_grad=3, dtype=torch.float64)

    assert bool((picture(*leaves) > 0).any())
    assert torch.autograd.gradcheck(picture, leaves, eps=1e-5, atol=1e-6, rtol=2e-3, fast_mode=True)


# Lights are sampled only, and at one vertex: then the estimator itself is a differentiable function of all of these.
DIRECT = {"max_depth": 3, "strategy": "light"}


def test_what_a_mirror_shows_follows_the_geometry():
    described = room(GOLD, DIRECT)
    del described["shapes"]["bulb"], described["shapes"]["behind"]
    names = ("shapes.plate.to_world", "shapes.before.to_world", "camera.to_world", "shapes.lamp.vertices")
    checked(torchpt.load(described, "cpu"), *names)


def test_a_mirrors_colours():
    scene = torchpt.load(room(GOLD, DIRECT), "cpu")
    checked(scene, "materials.plate.eta", "materials.plate.k")
