"""Gradients of cameras by kernels: every camera's rays are differentiated by one, and agree with tensor operations."""

from __future__ import annotations

import warnings

import pytest
import torch

import torchpt
from torchpt.core.errors import EdgeWarning
from torchpt.engines.kernels.backward import KernelsBackward

CAMERAS = {
    "perspective": {"type": "perspective", "fov": 40.0, "principal_point_offset_x": 0.1, "pixel_aspect": 1.1},
    "thinlens": {"type": "thinlens", "fov": 40.0, "aperture_radius": 0.1, "focus_distance": 3.0},
    "orthographic": {"type": "orthographic", "width": 2.0},
}


@pytest.mark.parametrize("name", CAMERAS)
def test_camera_by_kernels(name: str, monkeypatch: pytest.MonkeyPatch):
    calls: list[int] = []
    add = KernelsBackward._add_all_lanes
    monkeypatch.setattr(KernelsBackward, "_add_all_lanes", lambda self, *given: (calls.append(1), add(self, *given))[1])
    pose = {"origin": [0.3, 0.2, 3.0], "target": [0.0, 0.0, 0.0], "up": [0.0, 1.0, 0.0]}
    description = {
        "camera": {**CAMERAS[name], **pose},
        "materials": {"grey": {"type": "diffuse", "reflectance": [0.5, 0.6, 0.7]}},
        "shapes": {"ball": {"type": "sphere", "radius": 2.0, "material": "grey"}},
        "lights": {
            "sky": {"type": "constant", "radiance": [1.0, 0.9, 0.8]},
            "lamp": {"type": "point", "intensity": 9.0, "position": [1, 2, 4]},
        },
    }
    scene = torchpt.load(description, device="cpu")
    # With a shape that moves too; a pinhole that moves alone has its gradient without its rays.
    names = ["shapes.ball.to_world", *(key for key in scene.params if key.startswith("camera."))]

    def gradients(compile: str) -> list[torch.Tensor]:
        values = {key: scene.params[key].clone().requires_grad_() for key in names}
        film = {"width": 24, "height": 16, "filter": "box"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", EdgeWarning)
            image = torchpt.render(scene, params=values, spp=16, seed=1, film=film, edges=False, compile=compile)
        weights = torch.linspace(0, 1, image.numel()).view(image.shape)
        return list(torch.autograd.grad(image, list(values.values()), weights))

    found = gradients("on")
    assert calls
    expected = gradients("off")
    for key, a, b in zip(names, found, expected, strict=True):
        assert (a - b).abs().max() <= 2e-4 * b.abs().max(), key
        assert b.abs().max() > 0
