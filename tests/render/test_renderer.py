"""A renderer made once gives what ``render`` gives, to the bit."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.errors import SceneError
from torchpt.engines.kernels import threads
from torchpt.rendering import requests
from torchpt.scene.prepare import scene_cache

FILM = {"width": 10, "height": 8}
WALL, BALL = "materials.white.reflectance", "shapes.ball.to_world"
SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 16, "height": 16},
    "integrator": {"type": "path", "max_depth": 3},
    "materials": {"white": {"type": "diffuse", "reflectance": 0.7}},
    "shapes": {
        "wall": {"type": "rectangle", "material": "white", "transform": [{"scale": 2}, {"translate": [0, 0, -1]}]},
        "ball": {"type": "sphere", "radius": 0.6, "material": "white"},
    },
    "lights": {"sky": {"type": "constant", "radiance": 0.9}},
}


@pytest.fixture
def scene() -> torchpt.Scene:
    return torchpt.load(SCENE, "cpu")


def gradient(picture: Tensor, value: Tensor) -> Tensor:
    (grad,) = torch.autograd.grad(picture.square().sum(), value)
    return grad


def test_pictures_and_gradients_are_those_of_render(scene: torchpt.Scene) -> None:
    """Of the scene's parameters, of others, and after a change in place."""
    renderer = torchpt.Renderer(scene, film=FILM, spp=2, seed=5)
    for level in (0.7, 0.3):
        assert renderer().equal(torchpt.render(scene, film=FILM, spp=2, seed=5))
        assert renderer(seed=6).equal(torchpt.render(scene, film=FILM, spp=2, seed=6))
        value = torch.full((3,), level, requires_grad=True)
        picture, expected = (
            renderer({WALL: value}),
            torchpt.render(scene, film=FILM, spp=2, seed=5, params={WALL: value}),
        )
        assert picture.shape == (8, 10, 3) and picture.equal(expected)
        grad = gradient(picture, value)
        assert grad.any() and grad.equal(gradient(expected, value))
        scene.params[WALL].mul_(0.5)


def test_seeds_are_those_of_render(scene: torchpt.Scene) -> None:
    """The scene's own, a number, a tensor of one, or a new one for each call."""
    renderer = torchpt.Renderer(scene, film=(10, 8), spp=1)
    assert renderer().equal(torchpt.render(scene, film=FILM, spp=1))
    assert renderer(seed=torch.tensor(4)).equal(torchpt.render(scene, film=FILM, spp=1, seed=4))
    assert torchpt.Renderer(scene, film=FILM, spp=1, seed=4)().equal(renderer(seed=4))
    drawing = torchpt.Renderer(scene, film=FILM, spp=1, seed=None)
    torch.manual_seed(3)
    first, second = drawing(), drawing()
    torch.manual_seed(3)
    assert not first.equal(second) and drawing().equal(first) and renderer(seed=None).equal(second)


def test_poses_move(scene: torchpt.Scene) -> None:
    renderer = torchpt.Renderer(scene, film=FILM, spp=1, seed=0)
    before = renderer()
    moved = scene.params[BALL].clone()
    moved[0, 3] += 0.4
    assert not renderer({BALL: moved}).equal(before)
    fresh = torchpt.load(SCENE, "cpu")
    assert renderer({BALL: moved}).equal(torchpt.render(fresh, film=FILM, spp=1, seed=0, params={BALL: moved}))
    assert renderer().equal(before)


def test_full_returns_a_rendering(scene: torchpt.Scene) -> None:
    renderer = torchpt.Renderer(scene, full=True, film={**FILM, "aovs": ["normal"]}, spp=2)
    assert renderer.settings.film.width == 10 and renderer.settings.render.spp == 2
    assert set(renderer().layers) == {"normal"} and "10 x 8, 2 spp" in repr(renderer)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"film": {"width": 0}}, "film.width"),
        ({"spp": 0}, "render.spp"),
        ({"integrator": "pat"}, "integrator.type"),
        ({"device": "cuda:7"}, "device"),
        ({"seed": -1}, "render.seed"),
    ],
)
def test_settings_are_checked_when_it_is_made(scene: torchpt.Scene, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message) as found:
        torchpt.Renderer(scene, **options)
    assert "\n" not in str(found.value)


def test_arguments_that_it_does_not_take(scene: torchpt.Scene) -> None:
    for name in ("params", "spq"):
        with pytest.raises(TypeError, match=name):
            torchpt.Renderer(scene, **{name: None})  # pyright: ignore[reportArgumentType]
    with pytest.raises(SceneError, match="scene"):
        torchpt.Renderer("cornell_box")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"materials.white.reflectanc": torch.ones(3)}, "reflectanc"),
        ({WALL: torch.ones(4)}, "shape"),
        ({WALL: torch.full((3,), 2.0)}, WALL),
        ({BALL: torch.ones(3, 3)}, "shape"),
        ({3: torch.ones(3)}, "names of scene.params"),
        ([WALL], "a mapping"),
    ],
)
def test_parameters_are_checked_at_each_call(scene: torchpt.Scene, params: Any, message: str) -> None:
    renderer = torchpt.Renderer(scene, film=FILM, spp=1)
    with pytest.raises(SceneError, match=message) as found:
        renderer(params)
    assert "\n" not in str(found.value)
    with pytest.raises(SceneError, match="render.seed"):
        renderer(seed=-3)


def test_settings_are_read_once(scene: torchpt.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """By ``render`` too, whatever the seed and parameters; other settings are read anew."""
    read: list[Any] = []
    complete = requests.complete_settings

    def counted(*arguments: Any) -> Any:
        read.append(arguments)
        return complete(*arguments)

    monkeypatch.setattr(requests, "complete_settings", counted)
    for seed in range(3):
        value = scene.params[WALL] * (0.5 + 0.1 * seed)
        torchpt.render(scene, film=FILM, spp=1, seed=seed, params={WALL: value})
    assert len(read) == 1
    torchpt.render(scene, film={**FILM, "width": 11}, spp=1)
    assert len(read) == 2
    changed = copy.copy(scene)
    torchpt.render(changed, film=FILM, spp=1)
    assert len(read) == 3


def test_empty_cache_gives_memory_back(scene: torchpt.Scene) -> None:
    renderer = torchpt.Renderer(scene, film=FILM, spp=1, seed=2)
    value = torch.full((3,), 0.4, requires_grad=True)
    before = renderer({WALL: value})
    grad = gradient(before, value)
    assert threads._kept and scene_cache(scene).kernels is not None
    torchpt.empty_cache()
    assert not threads._kept and scene_cache(scene).kernels is None
    again = renderer({WALL: value})
    assert again.equal(before) and gradient(again, value).equal(grad)
