"""The picture of a scene does not depend on how large the scene is, from 1e-30 to 1e37, nor on which loop renders it."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.core.errors import SceneError
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings

DOWN = {"rotate": {"axis": [1, 0, 0], "angle": 90}}
SHEAR = {"matrix": [[1, 0.5, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
CEILING = {"translate": [0, 0.95, 0]}
LAMPS: dict[str, dict[str, Any]] = {
    "rectangle": {"type": "rectangle", "transform": [{"scale": 0.3}, DOWN, CEILING]},
    "sheared": {"type": "rectangle", "transform": [{"scale": 0.3}, SHEAR, DOWN, CEILING]},
    "disk": {"type": "disk", "transform": [{"scale": 0.3}, DOWN, CEILING]},
    "triangle": {
        "type": "mesh",
        "vertices": [[-0.3, 0.95, -0.3], [0.3, 0.95, -0.3], [0, 0.95, 0.3]],
        "faces": [[0, 1, 2]],
    },
    "sphere": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.2},
    "ellipsoid": {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.2, "transform": [{"scale": [1, 1, 1.3]}]},
    "cylinder": {"type": "cylinder", "center": [0, 0.6, 0], "radius": 0.1, "height": 0.3},
}


def room(scale: float, lamp: str = "sphere", **more: Any) -> dict[str, Any]:
    """A box with a ball and a lamp, all of it ``scale`` times as large."""
    shapes = {
        "walls": {
            "type": "cube",
            "flip_normals": True,
            "material": {"type": "diffuse", "reflectance": [0.6, 0.5, 0.4]},
        },
        "ball": {"type": "sphere", "center": [0.3, -0.6, 0.1], "radius": 0.4, "material": {"type": "diffuse"}},
        "lamp": {**copy.deepcopy(LAMPS[lamp]), "emission": [3, 2, 1]},
        **copy.deepcopy(more),
    }
    for shape in shapes.values():
        shape["transform"] = [*shape.get("transform", []), {"scale": scale}]
    return {"camera": {"origin": [0, 0, 0.9 * scale], "target": [0, 0, 0], "fov": 80}, "shapes": shapes}


def shoot(scene: Any, compile: str = "on", spp: int = 16, aovs: tuple[str, ...] = (), **keys: Any) -> Rendering:
    scene = torchpt.load(scene, device="cpu") if isinstance(scene, dict) else scene
    wishes = {
        "film": {"filter": "box", "width": 16, "height": 16, "aovs": list(aovs)},
        "integrator": {"type": "path", "max_depth": 4, "rr_depth": 100, **keys},
        "render": {"spp": spp, "compile": compile},
    }
    shot = render_scene(scene, settings(scene.description, wishes))
    assert shot.nonfinite_samples == 0
    return shot


def assert_same(a: Rendering, b: Rendering) -> None:
    """Sample by sample the same but for rounding, which may turn a path here and there."""
    x, y = a.image.double(), b.image.double()
    assert float(y.mean()) > 0.01
    assert float(((x - y).abs() <= 1e-4 * y + 1e-6).double().mean()) > 0.99
    assert float(x.mean()) == pytest.approx(float(y.mean()), rel=1e-3)


@pytest.fixture(scope="module")
def plain() -> dict[str, Rendering]:
    return {lamp: shoot(room(1.0, lamp)) for lamp in LAMPS}


@pytest.mark.parametrize("compile", ["on", "off"])
@pytest.mark.parametrize("scale", few([1e-30, 1e-18, 1e-10, 1e10, 1e15, 1e18, 1e20, 1e37], 3))
@pytest.mark.parametrize("lamp", ["rectangle", "sphere"])
def test_size_does_not_matter(plain, lamp, scale, compile):
    assert_same(shoot(room(scale, lamp), compile), plain[lamp])


@pytest.mark.parametrize("compile", ["on", "off"])
@pytest.mark.parametrize("scale", [1e-15, 1e18])
@pytest.mark.parametrize("lamp", few(["sheared", "disk", "triangle", "ellipsoid", "cylinder"], 2))
def test_nor_does_it_for_other_lamps(plain, lamp, scale, compile):
    assert_same(shoot(room(scale, lamp), compile), plain[lamp])


def many(scale: float) -> dict[str, Any]:
    """Lights enough for the light tree, and balls enough for a tree of boxes."""
    lights: dict[str, Any] = {
        f"lamp{k}": {"type": "sphere", "center": [0.2 * k - 0.8, 0.2, -0.5], "radius": 0.05, "emission": [2, 2, 3]}
        for k in range(8)
    }
    balls: dict[str, Any] = {
        f"ball{k}": {"type": "sphere", "center": [0.04 * k - 0.9, -0.9, -0.3], "radius": 0.03} for k in range(40)
    }
    return room(scale, **lights, **balls)


def copies(scale: float) -> dict[str, Any]:
    block = {"type": "cube", "transform": [{"scale": 0.2}, {"translate": [-0.5, -0.7, 0]}]}
    turn = {"rotate": {"axis": [1, 1, 0], "angle": 30}}
    again = {"type": "instance", "of": "block", "transform": [{"scale": 0.1}, turn, {"translate": [-0.5, 0, 0]}]}
    return room(scale, block=block, again=again)


def bumps(scale: float) -> dict[str, Any]:
    # Heights are lengths too.
    relief = {"type": "noise", "scale": 4, "color0": 0.0, "color1": 0.5 * scale}
    wall = {
        "type": "rectangle",
        "transform": [{"translate": [0, 0, -0.95]}],
        "material": {"type": "diffuse", "bump_map": relief},
    }
    return room(scale, wall=wall)


def lens(scale: float) -> dict[str, Any]:
    scene = room(scale)
    scene["camera"] |= {"type": "thinlens", "aperture_radius": 0.1 * scale, "focus_distance": 0.8 * scale}
    return scene


def parallel(scale: float) -> dict[str, Any]:
    camera = {"type": "orthographic", "origin": [0, 0, 0.9 * scale], "target": [0, 0, 0], "width": 1.5 * scale}
    return {**room(scale), "camera": camera}


def deltas(scale: float) -> dict[str, Any]:
    """Intensities grow with the square, so that as much arrives."""
    scene = room(scale)
    del scene["shapes"]["lamp"]
    bright = scale * scale
    scene["lights"] = {
        "point": {"type": "point", "position": [0, 0.5 * scale, 0], "intensity": bright},
        "sun": {"type": "directional", "direction": [0, -1, -0.2]},
        "spot": {
            "type": "spot",
            "position": [0.5 * scale, 0.5 * scale, 0],
            "target": [0, -scale, 0],
            "intensity": 2 * bright,
            "cutoff_angle": 60,
        },
    }
    return scene


@functools.cache
def ordinary(scene: Callable[[float], dict[str, Any]]) -> Rendering:
    return shoot(scene(1.0))


@pytest.mark.parametrize("compile", few(["on", "off"], 1))
@pytest.mark.parametrize("scale", few([1e-18, 1e18], 1))
@pytest.mark.parametrize("scene", [many, copies, bumps, lens, parallel, deltas])
def test_nor_for_what_else_has_a_length(scene, scale, compile):
    assert_same(shoot(scene(scale), compile), ordinary(scene))


def test_heights_of_bump_maps_are_seen_at_all():
    flat = room(1.0, wall={"type": "rectangle", "transform": [{"translate": [0, 0, -0.95]}]})
    assert (shoot(bumps(1.0)).image - shoot(flat).image).abs().max() > 0.01


@pytest.mark.parametrize("compile", ["on", "off"])
@pytest.mark.parametrize("scale", [1e-18, 1e18])
def test_layers_are_in_the_scenes_own_lengths(scale, compile):
    names = ("depth", "position", "normal")
    one, other = shoot(room(1.0), aovs=names), shoot(room(scale), compile, aovs=names)
    for name in ("depth", "position"):
        torch.testing.assert_close(other.layers[name] / scale, one.layers[name], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(other.layers["normal"], one.layers["normal"], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_derivatives_by_places_are_per_length(scale):
    def slope(size: float) -> torch.Tensor:
        scene = torchpt.load(room(size, "rectangle"), device="cpu")
        pose = scene.params["shapes.lamp.to_world"].clone().requires_grad_()
        with pytest.warns(torchpt.EdgeWarning):
            image = torchpt.render(
                scene,
                spp=4,
                params={"shapes.lamp.to_world": pose},
                film={"width": 8, "height": 8, "filter": "box"},
                integrator={"type": "direct"},
                edges=False,
            )
        return torch.autograd.grad(image.mean(), pose)[0][:3].double() * size

    one, other = slope(1.0), slope(scale)
    assert one.abs().max() > 1e-3
    torch.testing.assert_close(other, one, rtol=1e-3, atol=1e-4 * float(one.abs().max()))


def test_the_unit_is_told_and_is_one_in_ordinary_scenes():
    info = torchpt.load(room(1e18), device="cpu")
    assert info.space.unit == 2.0**59
    assert info.info(settings(info.description))["built"]["unit_of_length"] == 2.0**59
    for scale in (1e-8, 1.0, 1e8):
        assert torchpt.load(room(scale), device="cpu").space.unit == 1.0


@pytest.mark.parametrize("name", ["shapes.walls", "shapes.lamp", "shapes.again", "camera"])
def test_a_parameter_that_leaves_the_scene_far_behind_is_refused(name):
    scene = torchpt.load(copies(1.0), device="cpu")
    pose = torch.eye(4)
    pose[0, 3] = 1e20
    with pytest.raises(SceneError, match=r"up to 4\.4e\+12 from the middle of this scene"):
        torchpt.render(scene, spp=1, params={f"{name}.to_world": pose})


def test_a_parameter_that_makes_a_shape_too_large_is_refused():
    scene = torchpt.load(room(1.0, "triangle"), device="cpu")
    with pytest.raises(SceneError, match=r"params\.shapes\.lamp: expected places and sizes up to 4\.4e\+12"):
        torchpt.render(scene, spp=1, params={"shapes.lamp.to_world": torch.diag(torch.tensor([1e20, 1e20, 1e20, 1.0]))})
    with pytest.raises(SceneError, match=r"params\.shapes\.lamp: expected places and sizes up to 4\.4e\+12"):
        torchpt.render(scene, spp=1, params={"shapes.lamp.vertices": scene.params["shapes.lamp.vertices"] * 1e20})


def test_light_that_arrives_beyond_float32_is_refused():
    scene = deltas(1e-25)
    scene["lights"]["point"]["intensity"] = 1.0
    with pytest.raises(SceneError, match=r"lights\.point\.intensity: expected at most") as caught:
        shoot(scene)
    assert "\n" not in str(caught.value)
