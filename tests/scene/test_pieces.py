"""Worlds that share pieces with earlier ones have the bits of worlds that were assembled whole."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt
from torchpt.core.tree import leaves
from torchpt.extend import BsdfSample, Parameters, cosine_hemisphere
from torchpt.physics.parts import Part
from torchpt.physics.shapes.primitive import Corners
from torchpt.scene.world import pieces
from torchpt.scene.world.primitives import corners_of_all

QUAD = {"vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "faces": [[0, 1, 2], [0, 2, 3]]}
UVS = {"uvs": [[0, 0], [1, 0], [1, 1], [0, 1]]}
TEXELS = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1))
SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "materials": {
        "wall": {"type": "diffuse", "reflectance": TEXELS},
        "board": {"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": 0.2, "color1": 0.7}},
        "plain": {"type": "diffuse", "reflectance": [0.5, 0.4, 0.3]},
        "white": {"type": "diffuse", "reflectance": 0.8, "opacity": 0.7},
        "shiny": {"type": "roughconductor", "reflectance": 0.9, "roughness": 0.4},
        "mixed": {"type": "blend", "weight": 0.3, "a": "plain", "b": "shiny"},
    },
    "shapes": {
        "wall": {"type": "mesh", **QUAD, **UVS, "material": "wall"},
        "floor": {"type": "rectangle", "material": "board", "transform": [{"translate": [0, -1, 0]}]},
        "side": {"type": "rectangle", "material": "white", "transform": [{"translate": [-1, 0, 0.5]}]},
        "plate": {"type": "disk", "material": "mixed", "transform": [{"scale": 0.4}, {"translate": [0.2, 0.3, 0.5]}]},
        "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.5, "material": "shiny"},
        "tube": {"type": "cylinder", "center": [0.6, 0, 0.4], "radius": 0.2, "height": 0.5, "material": "plain"},
        "again": {"type": "instance", "of": "wall", "material": "plain", "transform": [{"translate": [0, 0.1, -1]}]},
        "lamp": {
            "type": "rectangle",
            "flip_normals": True,
            "transform": [{"scale": 2}, {"translate": [0, 0, 5]}],
            "emission": 3.0,
        },
    },
    "lights": {
        "sky": {"type": "constant", "radiance": 0.7},
        "bulb": {"type": "point", "position": [0, 1, 2], "intensity": 2.0},
    },
}


def load() -> torchpt.Scene:
    return torchpt.load(SCENE, "cpu")


def changed(value: Tensor) -> Tensor:
    """Return other values that the scene accepts: the first number is a little smaller."""
    value = value.clone()
    value.view(-1)[0] *= 0.99
    return value


def world_names(scene: torchpt.Scene) -> list[str]:
    return [name for name, value in scene.params.items() if not name.startswith("camera.") and value.numel()]


def assert_same(world: Any, other: Any) -> None:
    ours, theirs = leaves(world), leaves(other)
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert a.dtype == b.dtype and a.equal(b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_each_parameter_reaches_its_pieces(dtype: torch.dtype) -> None:
    scene = load()
    before = scene.world(dtype)
    for name in world_names(scene):
        given = {name: changed(scene.params[name])}
        world = scene.world(dtype, given)
        assert_same(world, load().world(dtype, given))
        new = {id(tensor) for tensor in leaves(world)} - {id(tensor) for tensor in leaves(before)}
        assert new, name


def test_changes_in_place_reach_their_pieces() -> None:
    """Of the scene's own parameters, and of those that a call hands over."""
    scene, fresh = load(), load()
    scene.world(torch.float32)
    given = {"shapes.wall.vertices": scene.params["shapes.wall.vertices"].repeat(1, 1)}
    for name in (
        "materials.plain.reflectance",
        "shapes.wall.to_world",
        "lights.bulb.intensity",
        "shapes.wall.vertices",
    ):
        of_both = [(scene.params, fresh.params), (given, given)] if name in given else [(scene.params, fresh.params)]
        for params, others in of_both:
            for tensor in {id(values[name]): values[name] for values in (params, others)}.values():
                tensor.view(-1)[0] *= 0.98
            assert_same(scene.world(torch.float32), fresh.world(torch.float32))
            fresh._pieces.clear()
            assert_same(scene.world(torch.float32, given), fresh.world(torch.float32, given))


def test_pieces_of_unchanged_parameters_are_the_same_tensors() -> None:
    """A colour changes the materials alone; equal values in another tensor change nothing."""
    scene, name = load(), "materials.plain.reflectance"
    own, _ = scene.world(torch.float32)
    colour = torch.tensor([0.1, 0.2, 0.3])
    first, geometry = scene.world(torch.float32, {name: colour})
    assert first.geometry is own.geometry and first.lights is own.lights and first.textures is own.textures
    assert first.materials.row is own.materials.row and first.materials is not own.materials
    again, same_geometry = scene.world(torch.float32, {name: colour.clone()})
    assert again is first and same_geometry is geometry


def test_corners_are_kept_in_no_world_and_made_once_for_each_geometry(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def counted(parts: Sequence[Part], *rest: Any) -> list[Corners]:
        made.append(len(parts))
        return corners_of_all(parts, *rest)

    monkeypatch.setattr(sys.modules["torchpt.scene.world.assemble"], "corners_of_all", counted)
    scene = load()
    scene.world(torch.float32)
    assert len(made) == 1
    for name in ("shapes.lamp.emission", "lights.bulb.intensity", "materials.white.reflectance"):
        scene.world(torch.float32, {name: changed(scene.params[name])})
    assert len(made) == 1  # the light table asks for the primitives alone
    name = "shapes.wall.vertices"
    scene.world(torch.float32, {name: changed(scene.params[name])})
    assert len(made) == 2


def test_pieces_on_a_tape_are_not_kept() -> None:
    scene, name = load(), "materials.plain.reflectance"
    colour = scene.params[name].clone().requires_grad_()
    for _ in range(2):
        world, _ = scene.world(torch.float32, {name: colour})
        taped = [tensor for tensor in leaves(world) if tensor.requires_grad]
        (gradient,) = torch.autograd.grad([tensor.sum() for tensor in taped], colour)
        assert gradient.any()
    with torch.no_grad():
        plain, _ = scene.world(torch.float32, {name: colour})
    assert not any(tensor.requires_grad for tensor in leaves(plain))
    world, _ = scene.world(torch.float32, {name: colour})  # after one of the same values without a tape
    assert any(tensor.requires_grad for tensor in leaves(world))


def test_worlds_of_inference_mode_can_be_differentiated_later() -> None:
    scene, name = load(), "materials.plain.reflectance"
    colour = torch.tensor([0.1, 0.2, 0.3])
    with torch.inference_mode():
        scene.world(torch.float32, {name: colour})
    world, _ = scene.world(torch.float32, {name: colour})
    assert not any(tensor.is_inference() for tensor in leaves(world))


@pytest.mark.parametrize(("most", "kept"), [(1 << 10, True), (4, False)])
def test_large_parameters_of_a_call_are_not_kept(most: int, *, kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparing them would take longer than assembling."""
    name = "shapes.wall.vertices"
    monkeypatch.setattr(pieces, "MOST_COMPARED", most)
    scene = load()
    given = {name: scene.params[name] * 0.5}
    first, _ = scene.world(torch.float32, given)
    second, _ = scene.world(torch.float32, given)
    assert (first.geometry.p0 is second.geometry.p0) == kept
    assert first.materials.parameters[0] is second.materials.parameters[0]


def test_changes_that_torch_does_not_count_reach_their_pieces() -> None:
    """Optimizers written by hand step on ``.data``; a tensor may share memory with an array."""
    scene, fresh = load(), load()
    given = {"shapes.wall.vertices": scene.params["shapes.wall.vertices"].repeat(1, 1)}
    scene.world(torch.float32, given)
    given["shapes.wall.vertices"].data.mul_(0.9)
    assert_same(scene.world(torch.float32, given), fresh.world(torch.float32, given))
    given["shapes.wall.vertices"].numpy()[:] *= 0.9
    fresh._pieces.clear()
    assert_same(scene.world(torch.float32, given), fresh.world(torch.float32, given))


def test_kept_pieces_do_not_change_with_a_callers_tensor() -> None:
    for name in world_names(load()):
        scene = load()
        given = changed(scene.params[name])
        wanted = given.clone()
        scene.world(torch.float32, {name: given})
        given.view(-1)[0] *= 0.9
        assert_same(scene.world(torch.float32, {name: wanted}), load().world(torch.float32, {name: wanted}))


class Gained(torchpt.Bsdf):
    """Diffuse, times a tensor of its own that it reads in :meth:`prepare`."""

    name = "gained"
    parameters = {"level": 0.5}  # noqa: RUF012

    def __init__(self) -> None:
        self.gain = torch.tensor(1.0, requires_grad=True)

    def weights(self):
        yield self.gain

    def prepare(self, values: Parameters) -> Parameters:
        return {"level": values["level"] * self.gain}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        pdf = wi[2].clamp_min(0.0) / math.pi
        return (parameters["level"] * pdf).expand(3, -1), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        wi = cosine_hemisphere(u)
        return BsdfSample(wi, wi[2] / math.pi, parameters["level"].expand(3, -1))


def test_models_of_a_user_are_asked_again() -> None:
    """What they prepare may depend on more than parameters."""
    model = Gained()
    plain = {**SCENE["materials"], "plain": {"type": "gained", "level": 0.4}}
    scene = torchpt.load({**SCENE, "materials": plain}, "cpu", bsdfs={"gained": model})
    name = "shapes.ball.to_world"

    def levels() -> list[Tensor]:
        world, _ = scene.world(torch.float32, {name: scene.params[name].clone()})
        return [values["level"] for values in world.materials.parameters if "level" in values]

    before = levels()
    with torch.no_grad():
        model.gain.mul_(0.5)
    assert before and all(b.equal(0.5 * a) for a, b in zip(before, levels(), strict=True))
