"""``torch.compile`` around code that renders: operators in the graph, the same bits, gradients, and what breaks a graph."""

from __future__ import annotations

import copy
import gc
import weakref
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from few import few
from torch import Tensor
from torch._dynamo.exc import Unsupported
from torch._dynamo.testing import CompileCounter

import torchpt
from torchpt.core.errors import RenderError, SceneError

WALL = "materials.wall.reflectance"
WISHES: dict[str, Any] = {
    "spp": 4,
    "threads": 1,
    "compile": "off",
    "film": {"width": 6, "height": 5, "filter": {"type": "box"}},
}
ROOM: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "integrator": {"type": "path", "max_depth": 3},
    "materials": {"wall": {"type": "diffuse", "reflectance": [0.6, 0.4, 0.2]}},
    "shapes": {"back": {"type": "rectangle", "material": "wall", "transform": [{"scale": 2}]}},
    "lights": {"sun": {"type": "point", "position": [1, 1, 2], "intensity": 5}},
}
#: torch's own, while it compiles.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    torch.compiler.reset()
    yield
    torch.compiler.reset()


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(ROOM, "cpu")


def picture(scene: torchpt.Scene, colour: Tensor, seed: int = 1) -> Tensor:
    return torchpt.render(scene, params={WALL: colour}, seed=seed, **WISHES)


def step(scene: torchpt.Scene, colour: Tensor, seed: int = 1) -> Tensor:
    return (picture(scene, colour.sigmoid(), seed) - 0.1).square().sum()


def gradient(step, scene: torchpt.Scene, seed: int = 1) -> tuple[Tensor, Tensor]:
    leaf = torch.tensor([0.5, 0.0, -1.0], requires_grad=True)
    value = step(scene, leaf, seed)
    value.backward()
    assert leaf.grad is not None and float(leaf.grad.abs().min()) > 0
    return value.detach(), leaf.grad


@pytest.mark.parametrize("backend", few(["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)], 1))
def test_one_graph_with_gradients_for_all_seeds(scene, backend):
    compiled = torch.compile(step, backend=backend, fullgraph=True)
    for seed in (1, 2, 3, 4):
        torch.testing.assert_close(gradient(compiled, scene, seed), gradient(step, scene, seed), rtol=1e-5, atol=0)


def test_the_picture_has_the_bits_of_an_eager_one(scene):
    compiled = torch.compile(picture, backend="aot_eager", fullgraph=True)
    colour = scene.params[WALL].clone()
    assert torch.equal(compiled(scene, colour), picture(scene, colour))
    with torch.no_grad(), torch.autocast("cpu"):
        assert torch.equal(compiled(scene, colour), picture(scene, colour))


def test_a_file_that_asks_for_layers_has_gradients(scene):
    own = torchpt.load({**ROOM, "film": {"width": 6, "height": 5, "aovs": ["depth", "variance"]}}, "cpu")

    def loss(colour):
        return torchpt.render(own, params={WALL: colour}, spp=4, threads=1, compile="off").square().mean()

    found = []
    for step in (loss, torch.compile(loss, backend="aot_eager")):
        leaf = torch.full((3,), 0.4, requires_grad=True)
        step(leaf).backward()
        found.append(leaf.grad)
    torch.testing.assert_close(*found, rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    "wish",
    few([{"dtype": torch.float16}, {"seed": -5}, {"seed": 1 << 63}, {"seed": True}, {"time_limit": float("inf")}], 2),
    ids=str,
)
def test_what_is_refused_is_refused_in_graphs(scene, wish):
    def step(colour):
        return torchpt.render(scene, params={WALL: colour}, **{**WISHES, **wish}).mean()

    for run in (step, torch.compile(step, backend="aot_eager")):
        with pytest.raises(SceneError):
            run(torch.full((3,), 0.4))


def test_another_seed_or_colour_compiles_nothing_anew(scene):
    counter = CompileCounter()
    compiled = torch.compile(step, backend=counter, fullgraph=True)
    for seed in range(1, 6):
        compiled(scene, torch.full((3,), 0.1 * seed), seed)
    assert counter.frame_count <= 2  # seed 1, and a graph for any seed


def test_several_renders_and_parameters_in_a_graph(scene):
    def loss(colour: Tensor, power: Tensor) -> Tensor:
        params = {WALL: colour, "lights.sun.intensity": power}
        images = [torchpt.render(scene, params=params, seed=seed, seed_grad=9, spp_grad=2, **WISHES) for seed in (1, 2)]
        return (images[0] * images[1]).mean()

    def gradients(loss) -> tuple[Tensor, ...]:
        leaves = [scene.params[name].clone().requires_grad_() for name in (WALL, "lights.sun.intensity")]
        return torch.autograd.grad(loss(*leaves), leaves)

    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(gradients(compiled), gradients(loss), rtol=1e-5, atol=0)


def test_a_parameter_of_the_scenes_own_that_wants_gradients(scene):
    own = copy.deepcopy(scene)
    own.params[WALL].requires_grad_()
    compiled = torch.compile(lambda: torchpt.render(own, **WISHES).mean(), backend="aot_eager", fullgraph=True)
    compiled().backward()
    found, own.params[WALL].grad = own.params[WALL].grad, None
    torchpt.render(own, **WISHES).mean().backward()
    assert found is not None and own.params[WALL].grad is not None
    torch.testing.assert_close(found, own.params[WALL].grad, rtol=1e-5, atol=0)


def test_changes_of_a_scene_are_seen_by_a_graph(scene):
    own = copy.deepcopy(scene)
    compiled = torch.compile(lambda: torchpt.render(own, **WISHES), backend="aot_eager", fullgraph=True)
    first = compiled()
    own.params[WALL].mul_(0.5)
    torch.testing.assert_close(compiled(), first / 2)


def test_two_scenes(scene):
    other = copy.deepcopy(scene)
    other.params[WALL].mul_(0.5)
    compiled = torch.compile(lambda scene: torchpt.render(scene, **WISHES), backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(other), compiled(scene) / 2)


@pytest.mark.filterwarnings("ignore:The .grad attribute")  # torch 2.13's, at any break that such a tensor crosses
def test_a_full_rendering_breaks_the_graph_and_no_more(scene):
    def loss(colour: Tensor) -> Tensor:
        return torchpt.render(scene, params={WALL: colour * 0.5}, full=True, **WISHES).image.mean() * 2

    compiled = torch.compile(loss, backend="aot_eager")
    leaf = scene.params[WALL].clone().requires_grad_()
    value = compiled(leaf)
    torch.testing.assert_close(value, loss(leaf))
    value.backward()
    assert leaf.grad is not None and float(leaf.grad.min()) > 0
    torch.compiler.reset()
    with pytest.raises(Unsupported):
        torch.compile(loss, backend="aot_eager", fullgraph=True)(leaf)


def test_errors_are_those_of_eager_renders(scene):
    compiled = torch.compile(picture, backend="aot_eager", fullgraph=True)
    with pytest.raises(torchpt.SceneError, match=f"params.{WALL}: expected"):
        compiled(scene, torch.full((3,), 7.0))
    with pytest.raises(torchpt.SceneError, match="spp"):
        torch.compile(lambda: torchpt.render(scene, spp=-1), backend="aot_eager")()


def test_a_graph_does_not_keep_its_scene(scene):
    def run() -> weakref.ref:
        own = copy.deepcopy(scene)
        torch.compile(lambda: torchpt.render(own, **WISHES), backend="aot_eager", fullgraph=True)()
        return weakref.ref(own)

    found = run()
    torch.compiler.reset()
    gc.collect()
    assert found() is None


def test_load_in_compiled_code(scene):
    compiled = torch.compile(lambda: torchpt.render(torchpt.load(ROOM, "cpu"), **WISHES) * 2, backend="aot_eager")
    torch.testing.assert_close(compiled(), torchpt.render(scene, **WISHES) * 2)


def test_a_scene_that_changed_before_its_gradient(scene: torchpt.Scene) -> None:
    own = copy.deepcopy(scene)
    compiled = torch.compile(picture, backend="aot_eager", fullgraph=True)
    colour = torch.tensor([0.5, 0.4, 0.3], requires_grad=True)
    image = compiled(own, colour)
    own.params[WALL].mul_(0.5)  # for which the picture has another
    image.sum().backward()
    image = compiled(own, colour)
    own.params["lights.sun.intensity"].mul_(10)
    with pytest.raises(RenderError, match=r"'lights.sun.intensity'\] was changed after the picture"):
        image.sum().backward()
    compiled(own, colour).sum().backward()


def test_what_is_no_tensor_is_refused_as_by_eager_code(scene: torchpt.Scene) -> None:
    compiled = torch.compile(picture, backend="aot_eager")
    with pytest.raises(SceneError, match=f"{WALL}: expected a floating tensor"):
        compiled(scene, [1.0, 1.0])  # type: ignore[arg-type]


@pytest.mark.filterwarnings("ignore:The .grad attribute:UserWarning")
def test_rays_are_traced_between_graphs(scene):
    o, d = torch.tensor([0.1, 0.2, 2.0]), torch.tensor([[0.0, 0.1, -1.0], [0.2, 0.0, -1.0]])

    def loss(colour: Tensor) -> Tensor:
        return torchpt.trace(scene, o, d, params={WALL: colour.sigmoid()}, seed_grad=1).square().sum()

    found = []
    counter = CompileCounter()
    for of in (loss, torch.compile(loss, backend=counter)):
        leaf = torch.tensor([0.5, 0.0, -1.0], requires_grad=True)
        value = of(leaf)
        found.append((value.detach(), *torch.autograd.grad(value, leaf)))
    assert counter.frame_count == 2
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
