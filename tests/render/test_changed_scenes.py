"""Scenes whose own parameters change while something that was made of them is still asked for: refused, or rightly followed."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import RenderError, SceneError
from torchpt.rendering.run import Run
from torchpt.scene.versions import VersionCounter

WALL, BALL, SKY = "materials.wall.reflectance", "materials.ball.reflectance", "lights.sky.radiance"
SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 16, "height": 16},
    "render": {"spp": 4},
    "materials": {name: {"type": "diffuse", "reflectance": [0.5, 0.4, 0.3]} for name in ("wall", "ball")},
    "shapes": {
        "wall": {"type": "rectangle", "material": "wall", "transform": [{"scale": 2}]},
        "ball": {"type": "sphere", "radius": 0.5, "material": "ball"},
    },
    "lights": {"sky": {"type": "constant", "radiance": 1.0}},
}
TEXELS = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def scene() -> torchpt.Scene:
    return torchpt.load(SCENE, "cpu")


def gradient(scene: torchpt.Scene) -> tuple[Tensor, Tensor]:
    colour = torch.tensor([0.5, 0.4, 0.3], requires_grad=True)
    return torchpt.render(scene, params={BALL: colour}, seed_grad=3), colour


def test_editions_are_numbered() -> None:
    versions, params = VersionCounter(), {"a": torch.zeros(2), "b": torch.zeros(2)}
    first = versions.of(params)
    assert first == versions.of(params) and min(first.values()) > 0
    params["a"].add_(1)
    second = versions.of(params)
    assert second["a"] != first["a"] and second["b"] == first["b"]
    params["b"] = params["b"].clone()
    third = versions.of(params)
    assert third["b"] != second["b"] and third["a"] == second["a"]
    with torch.inference_mode():
        params["a"] = torch.zeros(2)
    assert versions.of(params)["a"] < 0 < versions.of(params)["b"]


@pytest.mark.parametrize("compiled", ["on", "off"])
def test_an_iterator_that_changes_the_scene_that_it_gave(scene: torchpt.Scene, compiled: str) -> None:
    def changed() -> Iterator[torchpt.Scene]:
        for value in (1.0, 2.0):
            scene.params[SKY].fill_(value)
            yield scene

    with pytest.raises(
        RenderError, match=r"scenes\[1\]: scene.params\['lights.sky.radiance'\] was changed while the batch"
    ):
        torchpt.render_batch(changed(), compile=compiled)


def test_one_that_changes_a_scene_before_its_picture_is_there(scene: torchpt.Scene) -> None:
    def changed() -> Iterator[torchpt.Scene]:
        yield scene
        scene.params[SKY].fill_(2.0)
        yield copy.deepcopy(scene)

    with pytest.raises(
        RenderError, match=r"scenes\[0\]: scene.params\['lights.sky.radiance'\] was changed while the batch"
    ):
        torchpt.render_batch(changed(), spp=4096, compile="on")


def test_own_texels_are_the_same_ones_in_every_render() -> None:
    wall = {"type": "mesh", "material": "wall", "vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0]], "faces": [[0, 1, 2]]}
    uvs = {"uvs": [[0, 0], [1, 0], [1, 1]]}
    scene = torchpt.load({**SCENE, "shapes": {**SCENE["shapes"], "wall": {**wall, **uvs}}}, "cpu")
    scene.params[WALL] = TEXELS.clone()
    (alone, own), (first, colour), (second, _) = gradient(scene), gradient(scene), gradient(scene)
    alone.square().sum().backward()
    with torch.no_grad():
        torchpt.render(scene, params={WALL: torch.zeros_like(TEXELS)})
    first.square().sum().backward()
    assert colour.grad is not None and own.grad is not None and torch.equal(colour.grad, own.grad) and own.grad.any()
    both = torch.stack([colour.detach()] * 2).requires_grad_()
    torchpt.render_batch(scene, params={BALL: both}, seed_grad=3).square().sum().backward()
    assert both.grad is not None and both.grad[0].equal(own.grad) and both.grad[1].equal(own.grad)
    scene.params[WALL].mul_(0.5)
    with pytest.raises(RenderError, match="was changed after the picture"):
        second.sum().backward()


def test_numbers_that_do_not_go_together_are_refused_in_place_too() -> None:
    lamp = {"type": "spot", "position": [0, 0, 3], "target": [0, 0, 0], "cutoff_angle": 30.0, "beam_width": 20.0}
    scene = torchpt.load({**SCENE, "lights": {"lamp": {**lamp, "intensity": 3.0}}}, "cpu")
    scene.params["lights.lamp.beam_width"].fill_(60.0)
    for _ in range(2):  # it is not taken for checked
        with pytest.raises(SceneError, match="lights.lamp.beam_width: expected an angle of at most cutoff_angle"):
            torchpt.render(scene)
    scene.params["lights.lamp.beam_width"].fill_(10.0)
    torchpt.render(scene)


def test_views_check_only_what_is_theirs(scene: torchpt.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[str] = []
    check = torchpt.Scene.check_number
    monkeypatch.setattr(
        torchpt.Scene, "check_number", lambda self, name, value: (checked.append(name), check(self, name, value))
    )
    view = scene.seen_by({"origin": [0, 1, 4], "target": [0, 0, 0]})
    view.check_own()
    assert checked and all(name.startswith("camera.") for name in checked)
    checked.clear()
    scene.params[WALL].fill_(7.0)
    with pytest.raises(SceneError, match=WALL):
        scene.seen_by({"origin": [0, 1, 4], "target": [0, 0, 0]}).check_own()


def test_what_a_batch_returns_can_be_used_outside_of_inference_mode(scene: torchpt.Scene) -> None:
    with torch.inference_mode():
        pictures = torchpt.render_batch([scene])
    weight = torch.ones(1, requires_grad=True)
    (pictures * weight).sum().backward()
    assert weight.grad is not None


def test_renders_that_are_taken_alone_have_all_threads(scene: torchpt.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a batch, while other pictures are traced."""
    threads: list[int] = []
    sample_all = Run.sample_all
    monkeypatch.setattr(
        Run, "sample_all", lambda self, told: (threads.append(self.engine.budget.threads), sample_all(self, told))[1]
    )
    timed = torchpt.load({**SCENE, "render": {"spp": 4, "time_limit": 100.0}}, "cpu")
    torchpt.render_batch([scene, timed], threads=2, compile="on")
    assert threads == [2]
