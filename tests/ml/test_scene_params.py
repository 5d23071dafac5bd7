"""Numbers of a scene that no file could hold are refused, however they came there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

import torchpt
from torchpt.core.errors import SceneError
from torchpt.nn.parametrizations import RigidMotion

ALBEDO, BALL, FOV = "materials.paint.reflectance", "shapes.ball.to_world", "camera.fov"


def scene(colour: Any = 0.5) -> torchpt.Scene:
    return torchpt.load(
        {
            "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40.0},
            "film": {"width": 6, "height": 6},
            "materials": {"paint": {"type": "diffuse", "reflectance": colour}},
            "shapes": {"ball": {"type": "sphere", "material": "paint"}},
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )


def put(name: str, value: Any) -> Callable[[torchpt.Scene], None]:
    return lambda own: own.params.__setitem__(name, value)


@pytest.mark.parametrize("rendered", [False, True])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda own: own.params[FOV].fill_(-3.0), "params.camera.fov: expected"),
        (lambda own: own.params[ALBEDO].fill_(torch.nan), "params.materials.paint.reflectance: expected"),
        (
            lambda own: own.params[BALL][:3, :3].zero_(),
            "params.shapes.ball.to_world: expected a matrix that can be inverted",
        ),
        (lambda own: own.params["camera.to_world"][3].fill_(2.0), "last row is 0 0 0 1"),
        (put(ALBEDO, torch.tensor([-3.0, 2.0, 2.0])), "params.materials.paint.reflectance: expected"),
        (put(ALBEDO, torch.rand(2)), r"expected a floating tensor of shape \(3,\)"),
        (put(ALBEDO, 0.5), r"expected a floating tensor of shape \(3,\), got 0.5"),
        (
            put(ALBEDO, torch.rand(3).to_sparse()),
            r"expected a dense floating tensor of shape \(3,\).*sparse_coo tensor",
        ),
        (put(ALBEDO, None), r"expected a floating tensor of shape \(3,\)"),
        (put("foo", torch.rand(3)), "params.foo: expected the names that the scene was loaded with"),
        (lambda own: own.params.pop(ALBEDO), "params.materials.paint.reflectance: .* got 'nothing'"),
    ],
)
def test_refused(change: Callable[[torchpt.Scene], Any], says: str, rendered: bool) -> None:
    own = scene()
    if rendered:
        torchpt.render(own, spp=1)
    change(own)
    for grad in (torch.enable_grad(), torch.no_grad()):
        with grad, pytest.raises(SceneError, match=says):
            torchpt.render(own, spp=1)
    with pytest.raises(SceneError, match=says):
        torchpt.render_batch(own, spp=1)


def test_a_leaf_that_left_its_range_is_refused_without_gradients_too() -> None:
    leaf = torch.full((3,), 0.5, requires_grad=True)
    own = scene(leaf)
    with torch.no_grad():
        torchpt.render(own, spp=1)
        leaf.fill_(1.5)
        with pytest.raises(SceneError, match="reflectance"):
            torchpt.render(own, spp=1)


def test_a_renderer_under_autocast_has_the_same_poses() -> None:
    renderer = torchpt.nn.Renderer(scene(), BALL, spp=2)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.03)
    plain = renderer(seed=1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(renderer(seed=1), plain)


def test_many_turns_are_a_rotation() -> None:
    found = RigidMotion(torch.eye(4), 8.0)
    x = torch.cat((3000.0 * torch.randn(3, generator=torch.Generator().manual_seed(1)), torch.tensor([1.0, 0.0, -0.5])))
    pose = found(x)
    assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3), atol=1e-5)
    assert pose[:3, 3].tolist() == [8.0, 0.0, -4.0]
