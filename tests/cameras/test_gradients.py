"""Gradients with respect to the camera, exact against finite differences on a smooth scene."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from few import few

import torchpt

pytestmark = pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
ROOM: dict[str, Any] = {
    "film": {"width": 4, "height": 3, "filter": "box"},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
            "material": {"type": "diffuse", "reflectance": [0.8, 0.7, 0.6]},
        },
        "panel": {
            "type": "rectangle",
            "transform": [{"scale": 0.5}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0.4, 2.5, 0.5]}],
            "emission": [5, 4, 3],
        },
    },
}
POSE = {"origin": [0.2, 2, 0.7], "target": [0, 0, 0.4], "up": [0, 0, 1]}
LENS = {"type": "thinlens", "fov": 40, "aperture_radius": 0.2, "focus_distance": 1.4}


@pytest.mark.parametrize(
    ("camera", "key"),
    few(
        [
            ({"type": "perspective", "fov": 40, "fov_axis": "diagonal"}, "fov"),
            (LENS, "fov"),
            (LENS, "aperture_radius"),
            ({**LENS, "blades": 5}, "aperture_radius"),
            (LENS, "focus_distance"),
            (LENS, "to_world"),
            ({"type": "orthographic", "width": 1.2}, "width"),
            ({"type": "orthographic", "width": 1.2}, "to_world"),
        ],
        5,
    ),
)
def test_gradcheck(camera, key):
    # The floor alone is in view and in the light: nothing is hidden, so that the interior term is the whole derivative.
    # Light sampling alone: the estimator itself is differentiated.
    scene = torchpt.load({**ROOM, "camera": {**POSE, **camera}}, "cpu")
    name = f"camera.{key}"
    leaf = scene.params[name].double().requires_grad_()

    def picture(value: torch.Tensor) -> torch.Tensor:
        return torchpt.render(
            scene,
            params={name: value},
            spp=2,
            seed=3,
            seed_grad=3,
            dtype=torch.float64,
            integrator={"type": "direct", "strategy": "light"},
        )

    assert torch.autograd.gradcheck(picture, leaf, eps=1e-5, atol=1e-6, fast_mode=True)
    (gradient,) = torch.autograd.grad(picture(leaf).square().sum(), leaf)
    assert gradient.abs().max() > 1e-3
