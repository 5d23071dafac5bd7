"""Sizes of shapes as parameters: ``shapes.NAME.radius`` and others beside ``shapes.NAME.to_world``."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError

SHAPES: dict[str, dict[str, Any]] = {
    "sphere": {
        "radius": 0.8,
        "center": [0.1, 0.0, 0.0],
        "transform": [{"scale": 1.1}, {"translate": [0.0, 0.2, 0.0]}],
    },
    "cylinder": {"radius": 0.6, "height": 1.3, "transform": [{"rotate": {"axis": [1, 0, 0], "angle": 30}}]},
    "cone": {"apex": [0.0, 0.8, 0.0], "height": -1.4, "slope": 0.6},
}
#: Sizes of each shape, with other values for them.
OTHERS: list[tuple[str, str, Any]] = [
    ("sphere", "radius", 0.5),
    ("sphere", "center", [-0.2, 0.1, 0.3]),
    ("cylinder", "radius", 0.9),
    ("cylinder", "height", 0.7),
    ("cylinder", "center", [0.2, 0.1, 0.0]),
    ("cone", "height", -0.9),
    ("cone", "height", 0.5),  # the base above the apex
    ("cone", "slope", 0.3),
    ("cone", "apex", [0.1, 0.6, 0.2]),
]


def scene_of(kind: str, **changes: Any) -> torchpt.Scene:
    """Return a shape in free space under a point light, seen by direct light alone."""
    return torchpt.load(
        {
            "camera": {"origin": [0.5, 1.0, 5.0], "target": [0.0, 0.0, 0.0]},
            "film": {"width": 16, "height": 16, "filter": {"type": "box"}},
            "integrator": {"type": "path", "max_depth": 2},
            "shapes": {"c": {"type": kind, "material": {"type": "diffuse"}, **SHAPES[kind], **changes}},
            "lights": {"lamp": {"type": "point", "position": [2.0, 3.0, 4.0], "intensity": 30.0}},
        },
        "cpu",
    )


@pytest.fixture(scope="module")
def scenes() -> dict[str, torchpt.Scene]:
    return {kind: scene_of(kind) for kind in SHAPES}


@pytest.mark.parametrize(("kind", "key", "value"), OTHERS)
def test_a_size_means_what_it_means_in_a_scene_file(scenes: Any, kind: str, key: str, value: Any) -> None:
    scene, name = scenes[kind], f"shapes.c.{key}"
    plain = torchpt.render(scene, spp=4)
    assert torch.equal(torchpt.render(scene, spp=4, params={name: scene.params[name].clone()}), plain)
    made = torchpt.render(scene, spp=4, params={name: value})
    assert not torch.equal(made, plain)
    torch.testing.assert_close(made, torchpt.render(scene_of(kind, **{key: value}), spp=4), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "key"),
    [("sphere", "radius"), ("cylinder", "radius"), ("cylinder", "height"), ("cone", "slope"), ("cone", "height")],
)
def test_gradients_are_those_of_central_differences(scenes: Any, kind: str, key: str) -> None:
    """Interior and edges together; the differences take the same samples on both sides."""
    scene, name, step = scenes[kind], f"shapes.c.{key}", 0.05
    weights = torch.linspace(0.2, 1.0, 16)[:, None, None] * torch.linspace(1.0, 0.3, 16)[:, None]
    value = scene.params[name]

    def loss(value: Tensor, **wishes: Any) -> Tensor:
        return (torchpt.render(scene, params={name: value}, **wishes) * weights).mean()

    grads = []
    for seed in range(4):
        leaf = value.clone().requires_grad_()
        loss(leaf, spp=64, seed=seed).backward()
        assert leaf.grad is not None
        grads.append(float(leaf.grad))
    up, down = (loss(value + h, spp=2048, seed=9) for h in (step, -step))
    expected = float(up - down) / (2.0 * step)
    mean, spread = torch.tensor(grads).mean(), torch.tensor(grads).std() / 2.0
    assert abs(float(mean) - expected) < 0.02 * abs(expected) + 4.0 * float(spread)
    assert float(spread) < 0.1 * abs(expected)


def test_sizes_and_pose_go_together(scenes: Any) -> None:
    """The pose is the one at the sizes of the file; both have gradients in one render."""
    scene, moved = scenes["sphere"], scenes["sphere"].params["shapes.c.to_world"].clone()
    moved[0, 3] += 0.3
    values = {"shapes.c.to_world": moved.requires_grad_(), "shapes.c.radius": torch.tensor(0.5, requires_grad=True)}
    made = torchpt.render(scene, spp=4, params=values)
    transform = [*SHAPES["sphere"]["transform"], {"translate": [0.3, 0.0, 0.0]}]
    other = scene_of("sphere", radius=0.5, transform=transform)
    torch.testing.assert_close(made.detach(), torchpt.render(other, spp=4), rtol=1e-4, atol=1e-5)
    made.sum().backward()
    for value in values.values():
        assert value.grad is not None and bool(value.grad.any())


def test_sizes_of_the_scene_itself_can_change() -> None:
    scene = scene_of("cylinder")
    before = torchpt.render(scene, spp=2)
    scene.params["shapes.c.radius"].mul_(1.5)
    expected = torchpt.render(scene_of("cylinder"), spp=2, params={"shapes.c.radius": 0.6 * 1.5})
    made = torchpt.render(scene, spp=2)
    assert not torch.equal(made, before)
    torch.testing.assert_close(made, expected, rtol=1e-5, atol=1e-6)
    for other in (copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert torch.equal(torchpt.render(other, spp=2), made)
    scene.params["shapes.c.radius"] = torch.tensor(0.6)
    assert torch.equal(torchpt.render(scene, spp=2), before)


def test_a_renderer_fits_a_radius() -> None:
    scene = scene_of("sphere")
    target = torchpt.render(scene, spp=64, seed=1, params={"shapes.c.radius": 0.6})
    renderer = torchpt.nn.Renderer(scene, "shapes.*.radius", spp=8)
    assert renderer.names == ("shapes.c.radius",)
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.1)
    for _ in range(20):
        optimizer.zero_grad()
        torchpt.losses.l2(renderer(), target).backward()
        optimizer.step()
    assert float(renderer.values()["shapes.c.radius"].detach()) == pytest.approx(0.6, abs=0.02)
    picture = renderer.eval()().detach()
    renderer.write()
    torch.testing.assert_close(torchpt.render(scene, spp=8), picture)
    torch.testing.assert_close(renderer().detach(), picture)


def test_patterns_leave_sizes_to_their_own_names(scenes: Any) -> None:
    names = torchpt.nn.Renderer(scenes["cone"], "shapes.*").names
    assert names == ("shapes.c.to_world", "shapes.c.material.reflectance")
    assert torchpt.nn.Renderer(scenes["cone"], ["shapes.?.slope"]).names == ("shapes.c.slope",)


def test_a_centre_far_away_keeps_its_digits() -> None:
    scene = torchpt.load(
        {
            "camera": {"origin": [1e6, 0.0, 5.0], "target": [1e6, 0.0, 0.0]},
            "film": {"width": 8, "height": 8},
            "shapes": {"c": {"type": "sphere", "center": [1e6, 0.0, 0.0]}},
            "lights": {"sky": {"type": "constant"}},
        },
        "cpu",
    )
    assert scene.params["shapes.c.center"].dtype == torch.float64
    moved = torchpt.render(scene, spp=2, params={"shapes.c.center": [1e6 + 0.01, 0.0, 0.0]})
    assert not torch.equal(moved, torchpt.render(scene, spp=2))


@pytest.mark.parametrize(
    ("kind", "key", "value", "says"),
    [
        ("sphere", "radius", 0.0, "params.shapes.c.radius: expected a finite number > 0"),
        ("sphere", "radius", -1.0, "params.shapes.c.radius: expected a finite number > 0"),
        ("sphere", "radius", 1e-39, "params.shapes.c.radius: expected sizes with which its pose is a matrix that"),
        ("sphere", "center", [1e30, 0.0, 0.0], "params.shapes.c.center: expected sizes with which its pose is a place"),
        ("sphere", "radius", [1.0, 2.0], r"params.shapes.c.radius: expected a floating tensor of shape \(\)"),
        ("cone", "height", 0.0, "params.shapes.c.height: expected a finite number other than 0"),
        ("cylinder", "height", torch.tensor(torch.nan), "params.shapes.c.height: expected numbers finite"),
    ],
)
def test_sizes_that_are_refused(scenes: Any, kind: str, key: str, value: Any, says: str) -> None:
    with pytest.raises(SceneError, match=says) as error:
        torchpt.render(scenes[kind], spp=1, params={f"shapes.c.{key}": value})
    assert "\n" not in str(error.value)
    if isinstance(value, float):
        own = copy.deepcopy(scenes[kind])
        own.params[f"shapes.c.{key}"].fill_(value)
        with pytest.raises(SceneError, match=says):
            torchpt.render(own, spp=1)
