"""Layers of first surfaces have gradients: what they show, and the edges of what shows."""

from __future__ import annotations

import functools
import math
from typing import Any

import pytest
import torch
from few import few

import torchpt

NAMES = ("alpha", "depth", "normal", "position", "albedo", "uv")
SCENE: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0.4, 5], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 12, "height": 12, "filter": "gaussian", "aovs": list(NAMES)},
    "integrator": {"type": "path", "max_depth": 2},
    "render": {"threads": 1},
    "materials": {"grey": {"type": "diffuse", "reflectance": [0.8, 0.5, 0.3]}},
    "lights": {"sky": {"type": "constant"}},
    "shapes": {
        "ball": {"type": "sphere", "radius": 0.9, "material": "grey"},
        "cube": {
            "type": "cube",
            "transform": [{"scale": 0.4}, {"rotate": {"axis": [1, 2, 3], "angle": 50}}, {"translate": [0.9, 0.4, 1]}],
        },
    },
}  # fmt: skip


def weights(channels: int) -> torch.Tensor:
    x = torch.linspace(0.0, 1.0, 12, dtype=torch.float64)
    return torch.stack([torch.cos((2 + c) * x)[:, None] * torch.sin(1 + (3 - c) * x)[None] for c in range(channels)], 2)


def test_alpha_of_a_disk_that_grows() -> None:
    camera = {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "width": 4}
    film = {"width": 16, "height": 16, "filter": "box", "aovs": ["alpha"]}
    scene = torchpt.load({**SCENE, "camera": camera, "film": film, "shapes": {"it": {"type": "disk"}}}, "cpu")
    pose = scene.params["shapes.it.to_world"].double().requires_grad_()
    rendering = torchpt.render(scene, params={"shapes.it.to_world": pose}, spp=4, edge_spp=32, full=True)
    rendering.layers["alpha"].double().sum().backward()
    assert pose.grad is not None
    assert float(pose.grad[0, 0] + pose.grad[1, 1]) / 16 == pytest.approx(2 * math.pi, rel=2e-3)


SHIFT = 0.03


def losses(moved: str, value: torch.Tensor, *names: str, **wish: Any) -> list[torch.Tensor]:
    """A weighted sum of each of some layers, with a pose of a thing."""
    scene = torchpt.load({**SCENE, "film": {**SCENE["film"], "aovs": list(names)}}, "cpu")
    layers = torchpt.render(scene, params={moved: value}, full=True, **wish).layers
    return [(layers[name].double() * weights(layers[name].shape[2])).mean() for name in names]


@functools.cache
def differences(moved: str) -> dict[str, float]:
    """Central differences of all layers by the first coordinate of a pose's place, from the same pictures."""
    base, shift = torchpt.load(SCENE, "cpu").params[moved].double(), torch.zeros(4, 4, dtype=torch.float64)
    shift[0, 3] = SHIFT
    with torch.no_grad():
        more, less = (losses(moved, base + sign * shift, *NAMES, spp=2048) for sign in (1, -1))
    return {name: float(a - b) / (2 * SHIFT) for name, a, b in zip(NAMES, more, less, strict=True)}


@pytest.mark.parametrize("name", few(NAMES, 3))
@pytest.mark.parametrize("moved", few(["camera.to_world", "shapes.cube.to_world", "shapes.ball.to_world"], 2))
def test_agree_with_central_differences(name: str, moved: str) -> None:
    leaf = torchpt.load(SCENE, "cpu").params[moved].double().requires_grad_()
    losses(moved, leaf, name, spp=64, edge_spp=64)[0].backward()
    assert leaf.grad is not None
    assert float(leaf.grad[0, 3]) == pytest.approx(differences(moved)[name], rel=0.03, abs=0.004)


def test_names_of_things_stay_off_the_tape() -> None:
    scene = torchpt.load({**SCENE, "film": {**SCENE["film"], "aovs": ["object_id", "depth"]}}, "cpu")
    pose = scene.params["shapes.ball.to_world"].requires_grad_()
    layers = torchpt.render(scene, params={"shapes.ball.to_world": pose}, spp=2, full=True).layers
    assert layers["depth"].requires_grad and not layers["object_id"].requires_grad
