"""What a gradient leaves out is found on any device."""

from __future__ import annotations

from typing import Any

import pytest
import torch

import torchpt
from torchpt.core.tree import map_leaves
from torchpt.gradients.edges import left_out
from torchpt.physics.cameras import Camera
from torchpt.scene.formats.description import settings


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_a_camera_is_asked_about_points_on_its_own_device(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors on `meta` are refused beside those of another device, as on CUDA."""
    camera = {"type": kind, "origin": [0, 0, 4], "target": [0, 0, 0]}
    scene = torchpt.load({"camera": camera, "lights": {"sky": {"type": "constant"}}}, "cpu")
    wish = settings(scene.description)
    expected, made = left_out(scene, wish), scene.camera

    def away(*args: Any) -> Camera:
        return map_leaves(lambda tensor: tensor.to("meta"), made(*args))

    monkeypatch.setattr(scene, "camera", away)
    monkeypatch.setattr(scene, "device", torch.device("meta"))
    assert left_out(scene, wish) == expected
