"""Edges that lie on one another, on the film, in space or along cuts, count once; shadows whatever the size of the scene."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

import torchpt

GLOWS = {"material": "black", "emission": [1, 1, 1]}
ABOVE: dict[str, Any] = {
    "camera": {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0], "width": 4},
    "film": {"width": 16, "height": 16, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 1},
    "materials": {"black": {"type": "diffuse", "reflectance": 0}},
}
#: A 16th of the film's width is .25, so that the sum over the pixels times this is an area.
AREA = 1.0 / 16.0
OCTAHEDRON = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
CORNERS = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]


def scene_of(shapes: dict[str, Any], **more: Any) -> torchpt.Scene:
    return torchpt.load({**ABOVE, **more, "shapes": shapes}, "cpu")


def area(scene: torchpt.Scene, params: dict[str, Tensor], columns: slice, **more: Any) -> Tensor:
    """Return the lit area within columns of the picture."""
    picture = torchpt.render(scene, params=params, spp=16, edge_spp=64, seed=0, **more)
    return picture[:, columns, 0].double().sum() * AREA


def shifted(scene: torchpt.Scene, names: list[str], columns: slice, axis: int = 0) -> float:
    """Return the derivative of the lit area within columns as shapes move together along an axis."""
    x = torch.zeros((), dtype=torch.float64, requires_grad=True)
    move = torch.zeros(4, 4, dtype=torch.float64)
    move[axis, 3] = 1.0
    poses = {f"shapes.{name}.to_world": scene.params[f"shapes.{name}.to_world"].double() + x * move for name in names}
    area(scene, poses, columns).backward()
    assert x.grad is not None
    return float(x.grad)


@pytest.mark.parametrize("distance", [5, 50, 1000])
def test_edges_behind_others_on_one_line_of_the_film_do_not_count(distance: int) -> None:
    """From above, the sides of a cube are lines, and all of their edges lie on its outline."""
    camera = {**ABOVE["camera"], "origin": [0, 0, distance]}
    scene = scene_of({"box": {"type": "cube", "transform": [{"scale": [0.53, 0.5, 0.5]}], **GLOWS}}, camera=camera)
    assert shifted(scene, ["box"], slice(8, None)) == pytest.approx(1.0, rel=0.01)


@pytest.mark.parametrize("height", [0.5, 1.5, -1.5])
def test_rims_of_closed_cylinders_count_from_both_sides(height: float) -> None:
    """The axis is along y: an ellipse and, where it is seen at an angle, the side."""
    camera = {"type": "orthographic", "origin": [0, -5, height], "target": [0, 0, 0], "up": [0, 0, 1], "width": 4}
    body = {"type": "cylinder", "radius": 0.6, "height": 1.0, "capped": True, **GLOWS}
    scene = scene_of({"body": body}, camera=camera)
    names = ["shapes.body.radius", "shapes.body.height"]
    found = torchpt.gradient(scene, lambda p: p[..., 0].sum() * AREA, names, spp=64, edge_spp=64).gradients
    sine, cosine = abs(height) / math.hypot(5, height), 5 / math.hypot(5, height)
    assert float(found[names[0]]) == pytest.approx(2 * math.pi * 0.6 * cosine + 2 * sine, rel=0.02)
    assert float(found[names[1]]) == pytest.approx(2 * 0.6 * sine, rel=0.05, abs=0.01)


def test_faces_that_lie_on_one_another_have_one_outline() -> None:
    turn = [{"rotate": {"axis": [1, 2, 3], "angle": 20}}]
    found = []
    for faces in (OCTAHEDRON, OCTAHEDRON + [face[::-1] for face in OCTAHEDRON]):
        mesh = {"type": "mesh", "vertices": CORNERS, "faces": faces, "face_normals": True, "transform": turn, **GLOWS}
        found.append(shifted(scene_of({"it": mesh}), ["it"], slice(9, None)))
    assert found[1] == pytest.approx(found[0], rel=0.02)


def test_faces_of_one_edge_on_one_side_of_it_have_one_outline() -> None:
    vertices = [[0, -0.5, 0], [0, 0.5, 0], [-1, 0, 0], [-0.9, 0, -0.2], [-0.8, 0, -0.4]]
    scene = scene_of(
        {"it": {"type": "mesh", "vertices": vertices, "faces": [[0, 1, 2], [0, 1, 3], [0, 1, 4]], **GLOWS}}
    )
    found = torchpt.gradient(scene, lambda p: p[..., 0].sum() * AREA, ["shapes.it.vertices"], spp=16, edge_spp=64)
    assert float(found.gradients["shapes.it.vertices"][:2, 0].sum()) == pytest.approx(0.5, rel=0.02)


def test_a_wedge_of_two_meshes_has_one_outline() -> None:
    shapes = {
        name: {"type": "mesh", "vertices": [[0, -0.5, 0], [0, 0.5, 0], [-1, 0, z]], "faces": [[0, 1, 2]], **GLOWS}
        for name, z in (("a", 0.0), ("b", -1.0))
    }
    assert shifted(scene_of(shapes), ["a", "b"], slice(6, None)) == pytest.approx(0.5, rel=0.02)


def test_a_seam_that_parameters_open_has_two_borders() -> None:
    vertices = [[-1, -0.5, 0], [0, -0.5, 0], [0, 0.5, 0], [0, 0.5, 0], [0, -0.5, 0], [1, 0.5, 0]]
    scene = scene_of({"it": {"type": "mesh", "vertices": vertices, "faces": [[0, 1, 2], [4, 5, 3]], **GLOWS}})
    moved = torch.tensor(vertices, dtype=torch.float64)
    moved[3:, 0] += 0.5
    moved.requires_grad_()
    area(scene, {"shapes.it.vertices": moved}, slice(None)).backward()
    assert moved.grad is not None
    # The area left of the first's edge grows, that right of the second's shrinks.
    assert float(moved.grad[1:3, 0].sum()) == pytest.approx(0.5, rel=0.02)
    assert float(moved.grad[3:5, 0].sum()) == pytest.approx(-0.5, rel=0.02)


def grid(cells: int, half: float) -> dict[str, Any]:
    """Return a square mesh."""
    places = [half * (2.0 * k / cells - 1.0) for k in range(cells + 1)]
    faces = []
    for j in range(cells):
        for i in range(cells):
            a = j * (cells + 1) + i
            faces += [[a, a + 1, a + cells + 2], [a, a + cells + 2, a + cells + 1]]
    uvs = [[(x / half + 1.0) / 2.0, (y / half + 1.0) / 2.0] for y in places for x in places]
    return {"type": "mesh", "vertices": [[x, y, 0.0] for y in places for x in places], "faces": faces, "uvs": uvs}


def test_a_cut_along_the_edges_of_a_mesh_counts_once() -> None:
    """A cube is sunk into a floor whose edges it meets, and into one whose edges lie elsewhere: the same cut."""
    camera = {"type": "orthographic", "origin": [0.3, -5, 5], "target": [0, 0, 0], "up": [0, 0, 1], "width": 4}
    body = {"type": "cube", "transform": [{"scale": [0.8, 0.8, 0.6]}], **GLOWS}
    for moves, axis in (("floor", 2), ("body", 1)):
        found = []
        for cells in (3, 4):
            scene = scene_of({"floor": {**grid(cells, 1.6), "material": "black"}, "body": body}, camera=camera)
            x = torch.zeros((), dtype=torch.float64, requires_grad=True)
            move = torch.zeros(4, 4, dtype=torch.float64)
            move[axis, 3] = 1.0
            name = f"shapes.{moves}.to_world"
            picture = torchpt.render(scene, params={name: scene.params[name].double() + x * move}, spp=16, edge_spp=64)
            picture[8:].double().sum().backward()
            assert x.grad is not None
            found.append(float(x.grad))
        assert found[1] == pytest.approx(found[0], rel=0.03)


def test_lines_of_textures_lie_on_the_edges_of_mirrored_meshes_too() -> None:
    """Squares of a checkerboard end at edges of the mesh."""
    squares = {"type": "checkerboard", "color0": [0.1] * 3, "color1": [0.9] * 3, "scale": 2}
    more = {
        "integrator": {"type": "path", "max_depth": 2},
        "lights": {"sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": [3, 3, 3]}},
        "materials": {"squares": {"type": "diffuse", "reflectance": squares}},
    }
    mesh = {**grid(4, 1.0), "material": "squares", "transform": [{"scale": [-1, 1, 1]}, {"translate": [0.13, 0.07, 0]}]}
    scene = scene_of({"it": mesh}, **more)
    name = "shapes.it.to_world"
    pose = scene.params[name].double()
    weight = torch.linspace(0.0, 1.0, 16)[:, None, None]

    def brightness(pose: Tensor, spp: int) -> Tensor:
        picture = torchpt.render(scene, params={name: pose}, spp=spp, edge_spp=64)
        return (picture[:, 9:11] * weight).double().sum()

    leaf = pose.clone().requires_grad_()
    brightness(leaf, 4).backward()
    assert leaf.grad is not None
    move = torch.zeros(4, 4, dtype=torch.float64)
    move[1, 3] = 0.02
    difference = (brightness(pose + move, 512) - brightness(pose - move, 512)) / 0.04
    assert abs(float(difference)) > 0.5
    assert float(leaf.grad[1, 3]) == pytest.approx(float(difference), rel=0.05)


@pytest.mark.parametrize("light", ["sun", "sky", "bulb"])
def test_shadows_do_not_depend_on_what_is_far_away(light: str) -> None:
    lights = {
        "sun": {"type": "directional", "direction": [-1, -0.3, -1], "irradiance": [3, 3, 3]},
        "sky": {"type": "constant", "radiance": [1, 1, 1]},
        "bulb": {"type": "point", "position": [2, 0.6, 3], "intensity": [20, 20, 20]},
    }
    found = [_cube_over_floor(lights[light], far) for far in (0.0, 3000.0)]
    assert abs(found[0]) > 0.04
    assert found[1] == pytest.approx(found[0], rel=0.03)


def test_shadows_do_not_depend_on_how_far_the_light_is() -> None:
    found = []
    for times in (100.0, 2000.0):
        place, intensity = [2 * times, 0.6 * times, 3 * times], [20 * times * times] * 3
        found.append(_cube_over_floor({"type": "point", "position": place, "intensity": intensity}, 0.0))
    assert found[1] == pytest.approx(found[0], rel=0.03)
    assert found[0] == pytest.approx(-0.0345, rel=0.06)  # by central differences of pictures


def _cube_over_floor(light: dict[str, Any], far: float) -> float:
    """Return the derivative of the mean by the size of a cube over a floor, where another surface is ``far`` away."""
    scene = torchpt.load(
        {
            "camera": {"origin": [0, -4, 6], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 60},
            "film": {"width": 24, "height": 24, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 2},
            "lights": {"light": light},
            "materials": {
                "white": {"type": "diffuse", "reflectance": 0.8},
                "black": {"type": "diffuse", "reflectance": 0},
            },
            "shapes": {
                "floor": {"type": "rectangle", "material": "white", "transform": [{"scale": 10}]},
                "far": {
                    "type": "rectangle",
                    "material": "black",
                    "transform": [{"scale": 0.01}, {"translate": [far, 0, -1]}],
                },
                "cube": {
                    "type": "cube",
                    "material": "black",
                    "transform": [
                        {"scale": 0.3},
                        {"rotate": {"axis": [1, 2, 3], "angle": 30}},
                        {"translate": [0, 0, 1]},
                    ],
                },
            },
        },
        "cpu",
    )
    x = torch.zeros((), dtype=torch.float64, requires_grad=True)
    grows = torch.diag(torch.tensor((1.0, 1.0, 1.0, 0.0), dtype=torch.float64))
    pose = scene.params["shapes.cube.to_world"].double() + x * grows
    torchpt.render(scene, params={"shapes.cube.to_world": pose}, spp=4, edge_spp=32, seed=1).double().mean().backward()
    assert x.grad is not None
    return float(x.grad)
