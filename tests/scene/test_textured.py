"""Texels that take a number's or a colour's place after a scene is loaded: as if it had been loaded with them."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch

import torchpt
from torchpt.core.errors import SceneError

WALL, ROUGH = "materials.wall.reflectance", "materials.shiny.roughness"
QUAD = {"vertices": [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], "faces": [[0, 1, 2], [0, 2, 3]]}
UVS = {"uvs": [[0, 0], [1, 0], [1, 1], [0, 1]]}
SCENE: dict[str, Any] = {
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 16, "height": 16},
    "render": {"spp": 2, "threads": 1},
    "materials": {
        "wall": {"type": "diffuse", "reflectance": [0.5, 0.5, 0.5]},
        "shiny": {"type": "roughconductor", "reflectance": 0.9, "roughness": 0.4},
    },
    "shapes": {
        "wall": {"type": "mesh", **QUAD, **UVS, "material": "wall"},
        "ball": {"type": "sphere", "center": [0, 0, 1], "radius": 0.5, "material": "shiny"},
    },
    "lights": {"sky": {"type": "constant", "radiance": 0.7}},
}
TEXELS = torch.rand(3, 5, 3, generator=torch.Generator().manual_seed(1))
GREY = torch.rand(2, 2, 1, generator=torch.Generator().manual_seed(2)) * 0.5 + 0.2


def written(wall: Any, rough: Any) -> torchpt.Scene:
    scene = copy.deepcopy(SCENE)
    scene["materials"]["wall"]["reflectance"], scene["materials"]["shiny"]["roughness"] = wall, rough
    return torchpt.load(scene, "cpu")


def test_texels_by_params_are_those_of_the_dict() -> None:
    """Picture and gradients, and the scene stays what it is."""
    scene, before = torchpt.load(SCENE, "cpu"), torchpt.render(torchpt.load(SCENE, "cpu"))
    pictures, gradients = [], []
    for by_params in (True, False):
        wall, rough = TEXELS.clone().requires_grad_(), GREY.clone().requires_grad_()
        given = {WALL: wall, ROUGH: rough} if by_params else None
        loaded = scene if by_params else written(wall, rough)
        pictures.append(torchpt.render(loaded, params=given, seed_grad=3))
        pictures[-1].square().sum().backward()
        gradients.append((wall.grad, rough.grad))
    assert pictures[0].equal(pictures[1]) and not pictures[0].equal(before)
    for ours, theirs in zip(*gradients, strict=True):
        assert ours is not None and ours.any() and ours.equal(theirs)
    assert torchpt.render(scene).equal(before) and scene.params[WALL].shape == (3,)


@pytest.mark.slow
def test_other_sizes_and_other_parameters_follow() -> None:
    scene = torchpt.load(SCENE, "cpu")
    torchpt.render(scene, params={WALL: TEXELS})
    torchpt.render(scene, params={WALL: TEXELS * 0.5})
    assert len(scene.textured) == 1  # made once
    larger = torch.rand(7, 4, 3)
    scene.params["lights.sky.radiance"].mul_(0.5)
    found = torchpt.render(scene, params={WALL: larger})
    for size in range(1, 7):
        torchpt.render(scene, spp=1, params={WALL: torch.rand(size, 2, 3)})
    assert len(scene.textured) == 4
    other = written(larger, 0.4)
    other.params["lights.sky.radiance"].mul_(0.5)
    assert found.equal(torchpt.render(other))
    scene.params[WALL] = larger  # for good
    assert torchpt.render(scene).equal(found)
    for made in (copy.copy(scene), copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        assert torchpt.render(made).equal(found)


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (WALL, torch.rand(2, 2, 5), r"reflectance: expected texels \(H, W, C\)"),
        (WALL, torch.rand(2, 2, 3) + 1.0, r"reflectance: expected numbers in 0\.\.1"),
        (WALL, torch.rand(2, 2), r"floating tensor of shape \(3,\), or texels"),
        (WALL, torch.full((2, 2, 3), float("nan")), "a value that is not finite"),
        ("lights.sky.radiance", torch.rand(2, 2, 3), r"floating tensor of shape \(3,\), not texels"),
        ("shapes.ball.to_world", torch.rand(2, 2, 3), r"floating tensor of shape \(4, 4\), got"),
    ],
)
def test_what_is_wrong_is_one_line(name: str, value: torch.Tensor, words: str) -> None:
    scene = torchpt.load(SCENE, "cpu")
    with pytest.raises(SceneError, match=words) as error:
        torchpt.render(scene, params={name: value})
    assert "\n" not in str(error.value)


def test_later_texels_are_checked_too() -> None:
    scene = torchpt.load(SCENE, "cpu")
    torchpt.render(scene, params={WALL: TEXELS})
    with pytest.raises(SceneError, match="clamp before rendering"):
        torchpt.render(scene, params={WALL: TEXELS + 1.0})


def test_a_mesh_without_coordinates_is_refused() -> None:
    bare = {**SCENE, "shapes": {"wall": {"type": "mesh", **QUAD, "material": "wall"}}}
    with pytest.raises(SceneError, match="expected uvs .* for shapes.wall"):
        torchpt.render(torchpt.load(bare, "cpu"), params={WALL: TEXELS})


def test_what_is_tabulated_takes_no_texels() -> None:
    plastic = {**SCENE, "materials": {**SCENE["materials"], "shiny": {"type": "roughplastic", "alpha": 0.3}}}
    with pytest.raises(SceneError, match="is not built yet.*tabulates"):
        torchpt.render(torchpt.load(plastic, "cpu"), params={"materials.shiny.alpha": GREY})


def test_a_blend_reads_texels_inside_and_as_its_weight() -> None:
    mix = {"type": "blend", "a": "wall", "b": "shiny", "weight": 0.3}
    scene = {**SCENE, "materials": {**SCENE["materials"], "mix": mix}}
    scene["shapes"] = {"ball": {**SCENE["shapes"]["ball"], "material": "mix"}}
    given = {WALL: TEXELS, "materials.mix.weight": GREY}
    found = torchpt.render(torchpt.load(scene, "cpu"), params=given)
    told = copy.deepcopy(scene)
    told["materials"]["wall"]["reflectance"], told["materials"]["mix"]["weight"] = TEXELS, GREY
    assert found.equal(torchpt.render(torchpt.load(told, "cpu")))
