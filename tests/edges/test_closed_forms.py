"""Gradients of black shapes before an even sky: by how much they cover more of the film, in closed form."""

from __future__ import annotations

import math
import warnings
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.gradients.edges import left_out
from torchpt.scene.formats.description import settings

#: What the camera shows is 4 wide: a pixel of 16 is a quarter.
BASE: dict[str, Any] = {
    "camera": {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "width": 4},
    "film": {"width": 16, "height": 16, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 2},
    "render": {"threads": 1},
    "materials": {"black": {"type": "diffuse", "reflectance": 0}},
    "lights": {"sky": {"type": "constant", "radiance": [0.5, 1, 2]}},
}
RADIANCE = 3.5  # of the sky, all channels

#: About x, by so much: the axis of a cylinder comes toward the camera. Across the line of sight its side is less tall by the
#: cosine, and half of either end shows.
COS, SIN = math.cos(0.5), math.sin(0.5)
TILT = {"transform": [{"rotate": {"axis": [1, 0, 0], "angle": math.degrees(0.5)}}]}
UP = {"transform": [{"rotate": {"axis": [1, 0, 0], "angle": 90}}]}


def grown(shape: dict[str, Any], name: str = "shapes.it.to_world", **more: Any) -> torch.Tensor:
    """The gradient of the picture's integral over the plane z = 0."""
    scene = torchpt.load({**BASE, **more, "shapes": {"it": {"material": "black", **shape}}}, "cpu")
    leaf = scene.params[name].double().requires_grad_()
    picture = torchpt.render(scene, params={name: leaf}, spp=16, edge_spp=8)
    (picture.double().sum() / 16).backward()
    assert leaf.grad is not None
    return leaf.grad


@pytest.mark.parametrize("filter", few(["box", "gaussian", "mitchell", "tent"], 2))
def test_a_sphere_that_grows(filter: str) -> None:
    # d/ds of an area pi r^2 s^2 at s = 1, where s scales the pose.
    film = {**BASE["film"], "filter": filter}
    found = grown({"type": "sphere", "radius": 0.8}, film=film)
    along = float(found.diagonal()[:3].sum()) * 0.8
    # Gaussians of all pixels do not add up to quite 1 everywhere.
    assert along == pytest.approx(-2 * math.pi * 0.8**2 * RADIANCE, rel=1e-2 if filter == "gaussian" else 2e-3)


@pytest.mark.parametrize(
    ("shape", "area"),
    few(
        [
            ({"type": "disk", "transform": [{"scale": [0.8, 0.5, 1]}]}, math.pi * 0.4),
            ({"type": "rectangle", "transform": [{"scale": [0.8, 0.6, 1]}]}, 1.92),
            ({"type": "cube", "transform": [{"scale": 0.6}]}, 1.44),
            ({"type": "sphere", "transform": [{"scale": [0.8, 0.5, 1.3]}]}, math.pi * 0.4),
            ({"type": "cylinder", "radius": 0.5, "height": 1.2, "capped": True}, 1.2),
            (
                {"type": "cylinder", "radius": 0.5, "height": 1.2, "capped": False, **TILT},
                1.2 * COS + math.pi * 0.25 * SIN,
            ),
            ({"type": "cone", "apex": [0, 0.6, 0], "height": -1.2, "slope": 0.5}, 0.72),
            ({"type": "cone", "apex": [0, 0, 1], "height": 1.2, "slope": 0.5, "capped": False, **UP}, math.pi * 0.36),
        ],
        3,
    ),
    ids=["ellipse", "rectangle", "cube", "ellipsoid", "cylinder", "open cylinder", "cone", "open cone"],
)
def test_shapes_that_grow(shape: dict[str, Any], area: float) -> None:
    # Along the pose itself all lengths grow alike: x d/dx of an area is twice that.
    found = grown(shape)
    scene = torchpt.load({**BASE, "shapes": {"it": {"material": "black", **shape}}}, "cpu")
    pose = scene.params["shapes.it.to_world"].double()
    assert float((found * pose)[:2].sum()) == pytest.approx(-2 * area * RADIANCE, rel=4e-3)


def test_a_vertex_of_a_triangle() -> None:
    # The area of a triangle changes by half the opposite side as a corner moves across it.
    mesh = {"type": "mesh", "vertices": [[-1, -0.8, 0], [1, -0.8, 0], [0.2, 1, 0.3]], "faces": [[0, 1, 2]]}
    found = grown(mesh, "shapes.it.vertices")
    expected = torch.tensor([[0.9, 0.4, 0], [-0.9, 0.6, 0], [0.0, -1.0, 0]], dtype=torch.float64) * RADIANCE
    torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-2)


def test_a_camera_that_shows_more() -> None:
    # Of a film that shows twice the width a shape covers a quarter.
    found = grown({"type": "sphere", "radius": 0.8}, "camera.width")
    expected = 2 * math.pi * 0.8**2 / 4 * RADIANCE
    assert float(found) == pytest.approx(expected, rel=2e-3)


def test_edges_that_are_hidden_or_off_the_film_give_nothing() -> None:
    wall = {"type": "rectangle", "material": "black", "transform": [{"scale": 9}, {"translate": [0, 0, 2]}]}
    scene = torchpt.load({**BASE, "shapes": {"it": {"type": "cube", "material": "black"}, "wall": wall}}, "cpu")
    leaf = scene.params["shapes.it.to_world"].double().requires_grad_()
    torchpt.render(scene, params={"shapes.it.to_world": leaf}, spp=4).sum().backward()
    assert leaf.grad is not None and float(leaf.grad.abs().max()) == 0.0
    aside = {"type": "sphere", "material": "black", "center": [9, 0, 0]}
    assert float(grown(aside).abs().max()) == 0.0


def test_a_shape_behind_the_camera_gives_nothing() -> None:
    for kind in ("perspective", "orthographic"):
        camera = {"type": kind, "origin": [0, 0, 5], "target": [0, 0, 0]}
        found = grown({"type": "cube", "transform": [{"translate": [0, 0, 9]}]}, camera=camera)
        assert float(found.abs().max()) == 0.0


@pytest.mark.parametrize("opacity", few([1.0, 0.5], 1))
@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_two_surfaces_that_meet_count_once(opacity: float) -> None:
    """A seam between two walls moves with the camera: each of its two edges counts half, whatever lets light pass elsewhere."""
    veil = {"type": "diffuse", "opacity": opacity}
    shapes = {
        "veil": {"type": "sphere", "center": [0, 0, 90], "material": veil},
        "left": {"type": "rectangle", "emission": [1, 1, 1], "transform": [{"translate": [-1, 0, 0]}]},
        "right": {"type": "rectangle", "emission": [3, 3, 3], "transform": [{"translate": [1, 0, 0]}]},
    }
    film = {**BASE["film"], "crop": [4, 6, 8, 4]}  # none of their other borders
    scene = torchpt.load({**BASE, "film": film, "lights": {}, "shapes": shapes}, "cpu")
    leaf = scene.params["camera.to_world"].double().requires_grad_()
    torchpt.render(scene, params={"camera.to_world": leaf}, spp=4, edge_spp=64).double().sum().backward()
    assert leaf.grad is not None
    # Four rows of a seam of step 2 in three channels move by 4 pixels a unit.
    assert float(leaf.grad[0, 3]) == pytest.approx(4 * 3 * 2 * 4, rel=1e-3)


def test_parameters_that_only_make_jumps_are_named() -> None:
    board = {"type": "diffuse", "opacity": {"type": "checkerboard"}, "alpha_cutoff": 0.5}
    spot = {"type": "spot", "position": [0, 0, 3], "target": [0, 0, 0], "cutoff_angle": 20, "beam_width": 20}
    described = {**BASE, "shapes": {"it": {"type": "rectangle", "material": board}}, "lights": {"spot": spot}}
    scene = torchpt.load(described, "cpu")
    for name in ("lights.spot.cutoff_angle", "lights.spot.beam_width", "shapes.it.material.opacity.color0"):
        leaf = scene.params[name].clone().requires_grad_()
        with pytest.warns(torchpt.EdgeWarning, match=f"{name} changes the picture by jumps alone"):
            torchpt.render(scene, params={name: leaf}, spp=1)
    soft = torchpt.load({**described, "lights": {"spot": {**spot, "beam_width": 10}}}, "cpu")
    leaf = soft.params["lights.spot.cutoff_angle"].clone().requires_grad_()
    torchpt.render(soft, params={"lights.spot.cutoff_angle": leaf}, spp=1)
    # What counts is the value that is given, not that of the scene.
    with pytest.warns(torchpt.EdgeWarning, match="lights.spot.beam_width changes the picture by jumps alone"):
        torchpt.render(soft, params={"lights.spot.beam_width": torch.tensor(20.0, requires_grad=True)}, spp=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", torchpt.EdgeWarning)
        hard = torchpt.load({**BASE, "shapes": {"it": {"type": "rectangle"}}, "lights": {"spot": spot}}, "cpu")
        torchpt.render(hard, params={"lights.spot.beam_width": torch.tensor(10.0, requires_grad=True)}, spp=1)


@pytest.mark.parametrize(
    ("alpha", "warns"), [(0.3, False), (1e-6, True), ({"type": "checkerboard", "color0": 0.1, "color1": 0.3}, False)]
)
def test_only_rough_materials_that_are_next_to_mirrors_are_named(alpha: Any, warns: bool) -> None:
    material = {"type": "roughconductor", "alpha": alpha}
    described = {**BASE, "shapes": {"it": {"type": "rectangle", "material": material}}}
    scene = torchpt.load(described, "cpu")
    said = left_out(scene, settings(scene.description))
    assert any("mirrors" in line for line in said) == warns


def test_what_is_left_out_is_named() -> None:
    shapes = {"it": {"type": "sphere", "material": "black"}}

    def told(**more: Any) -> str:
        scene = torchpt.load({**BASE, "shapes": shapes, **more}, "cpu")
        leaf = scene.params["shapes.it.to_world"].requires_grad_()
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torchpt.render(scene, params={"shapes.it.to_world": leaf}, spp=1)
        return " ".join(str(one.message) for one in caught)

    assert told() == ""
    glass = {"black": {"type": "dielectric"}}
    assert "mirrors and clear glass" in told(materials=glass)
    assert told(materials={"black": {"type": "diffuse", "opacity": 0.5}}) == ""
    board = {"type": "checkerboard"}
    assert "textures of opacity" in told(materials={"black": {"type": "diffuse", "opacity": board}})
    blend = {"type": "blend", "a": {"type": "null"}, "b": {"type": "diffuse"}, "weight": board}
    assert "textures of opacity" in told(materials={"black": blend})
    squares = {"black": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}}
    assert "not interpolated" in told(materials=squares)  # it is a sphere
    lens = {"type": "thinlens", "origin": [0, 0, 5], "target": [0, 0, 0], "aperture_radius": 0.1, "focus_distance": 5}
    assert told(camera=lens) == ""
    spot = {"type": "spot", "position": [0, 3, 0], "target": [0, 0, 0], "cutoff_angle": 20, "beam_width": 20}
    assert "rims of spots" in told(lights={"spot": spot})


def test_edges_can_be_left_out() -> None:
    scene = torchpt.load({**BASE, "shapes": {"it": {"type": "sphere", "material": "black"}}}, "cpu")
    leaf = scene.params["shapes.it.to_world"].requires_grad_()
    with pytest.warns(torchpt.EdgeWarning, match="all visibility edges"):
        picture = torchpt.render(scene, params={"shapes.it.to_world": leaf}, spp=1, edges=False)
    picture.sum().backward()
    assert leaf.grad is None or float(leaf.grad.abs().max()) == 0.0


@pytest.mark.slow
def test_gradients_are_the_same_for_any_threads_and_memory() -> None:
    shapes = {"it": {"type": "cube", "transform": [{"scale": 0.6}]}, "ball": {"type": "sphere", "center": [1, 1, 2]}}
    scene = torchpt.load({**BASE, "integrator": {"type": "path", "max_depth": 4}, "shapes": shapes}, "cpu")
    found = []
    wishes: list[dict[str, Any]] = [{}, {"threads": 2}, {"max_memory": "3GB"}]
    for wish in wishes:
        leaf = scene.params["shapes.it.to_world"].clone().requires_grad_()
        torchpt.render(scene, params={"shapes.it.to_world": leaf}, spp=4, edge_spp=16, **wish).mean().backward()
        found.append(leaf.grad)
    assert torch.equal(found[0], found[1]) and torch.equal(found[0], found[2])
