"""Curves where surfaces cut through each other: areas in closed form, differences in reflected light, and what is no cut."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few

import torchpt
from torchpt.gradients.edges.bodies import bodies_of
from torchpt.gradients.edges.cuts import cuts_of
from torchpt.scene.formats.description import settings

#: What the camera shows from above is 4 wide: a pixel of 16 is a quarter.
ABOVE: dict[str, Any] = {
    "camera": {"type": "orthographic", "origin": [0, 0, 5], "target": [0, 0, 0], "up": [0, 1, 0], "width": 4},
    "film": {"width": 16, "height": 16, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 1},
    "render": {"threads": 1},
    "materials": {"black": {"type": "diffuse", "reflectance": 0}},
}
FLOOR = {"type": "rectangle", "material": "black", "transform": [{"scale": 1.7}]}
DISK = {"type": "disk", "material": "black"}
UPRIGHT = {"rotate": {"axis": [1, 0, 0], "angle": 90}}  # axes of cylinders and cones, along y, come to point up


def scene_of(body: dict[str, Any], floor: dict[str, Any] = FLOOR, **more: Any) -> torchpt.Scene:
    body = {"material": "black", "emission": [1, 1, 1], **body}
    return torchpt.load({**ABOVE, "shapes": {"floor": floor, "body": body}, **more}, "cpu")


def slope(scene: torchpt.Scene, name: str, row: int = 2, column: int = 3, seed: int = 0) -> float:
    """The derivative of the area that shines by an entry of a pose; by default how high it is."""
    leaf = scene.params[name].double().requires_grad_()
    picture = torchpt.render(scene, params={name: leaf}, spp=16, edge_spp=64, seed=seed)
    (picture.double().sum() / 48).backward()
    assert leaf.grad is not None
    return float(leaf.grad[row, column])


def lens(r: float, big: float, apart: float) -> float:
    """The derivative by r of the area in which disks of radius r and ``big`` overlap."""
    return 2 * r * math.acos((apart * apart + r * r - big * big) / (2 * apart * r))


#: Bodies of which the plane z = 0 leaves what shines above it, and the derivative of its area by their height.
SUNK: dict[str, tuple[dict[str, Any], float]] = {
    # a circle of radius sqrt(r^2 - c^2)
    "ball": ({"type": "sphere", "radius": 1.0, "center": [0.1, 0.2, -0.6]}, 2 * math.pi * 0.6),
    # z of it is 0.8 times that of a ball of radius 1 whose centre is 0.5 below; x and y are those of it times 1 and 0.7
    "ellipsoid": (
        {"type": "sphere", "transform": [{"scale": [1, 0.7, 0.8]}, {"translate": [0, 0, -0.4]}]},
        2 * math.pi * 0.7 * 0.5 / 0.8,
    ),
    # a strip between two lines sqrt(r^2 - c^2) off the axis
    "lying cylinder": (
        {"type": "cylinder", "center": [0, 0, -0.3], "radius": 0.5, "height": 1.4},
        2 * 1.4 * 0.3 / 0.4,
    ),
    # a circle of the radius that the cone has there: slope times the depth below the apex
    "cone": (
        {"type": "cone", "apex": [0, 0.8, 0], "height": -1.6, "slope": 0.75, "transform": [UPRIGHT]},
        2 * math.pi * 0.75 * 0.75 * 0.8,
    ),
    # about x by 45 degrees: a triangle of a ridge, 1.6 long, as wide as twice its height
    "cube on its edge": (
        {
            "type": "cube",
            "transform": [
                {"scale": [0.8, 0.6, 0.6]},
                {"rotate": {"axis": [1, 0, 0], "angle": 45}},
                {"translate": [0, 0, -0.3]},
            ],
        },
        1.6 * 2,
    ),
    # the same as a mesh, a roof
    "roof": (
        {
            "type": "mesh",
            "vertices": [
                [-0.8, -1, -0.6],
                [0.8, -1, -0.6],
                [-0.8, 0, 0.4],
                [0.8, 0, 0.4],
                [-0.8, 1, -0.6],
                [0.8, 1, -0.6],
            ],
            "faces": [[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]],
        },
        1.6 * 2,
    ),
}


@pytest.mark.parametrize("name", few(SUNK, 6))
@pytest.mark.parametrize("moved", ["body", "floor"])
def test_what_stands_out_of_a_floor(name: str, moved: str) -> None:
    body, expected = SUNK[name]
    found = slope(scene_of(body), f"shapes.{moved}.to_world")
    assert found == pytest.approx(expected if moved == "body" else -expected, rel=1e-2)


def test_cuts_and_outlines_that_hide_each_other() -> None:
    """From aside a part of the cut lies behind the ball, and a part of the ball's outline below the floor.

    The area is that of rays counted in float64: 6,000 x 6,000, the ball 0.02 higher and lower.
    """
    camera = {"type": "perspective", "origin": [1.5, -4, 2.5], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40}
    scene = scene_of({"type": "sphere", "radius": 0.6, "center": [0, 0, -0.25]}, camera=camera)
    found = sum(slope(scene, "shapes.body.to_world", seed=seed) for seed in range(8)) / 8
    assert found / 16 == pytest.approx(0.11385, rel=2e-3)


@pytest.mark.parametrize("moved", ["body", "floor"])
def test_a_ball_in_the_border_of_a_disk(moved: str) -> None:
    """Outside of the disk all of the ball is seen, over it what stands out: arcs of the circle in which they cut."""
    r, deep, apart = 1.0, 0.6, 1.1
    body = {"type": "sphere", "radius": r, "center": [apart, 0, -deep]}
    cut = math.sqrt(r * r - deep * deep)
    expected = lens(cut, 1.0, apart) * deep / cut
    found = slope(scene_of(body, DISK), f"shapes.{moved}.to_world")
    assert found == pytest.approx(expected if moved == "body" else -expected, rel=1e-2)


def test_a_radius_whose_outline_is_hidden() -> None:
    scene = scene_of({"type": "sphere", "radius": 1.0, "center": [0, 0, -0.6]})
    leaf = scene.params["shapes.body.radius"].double().requires_grad_()
    (torchpt.render(scene, params={"shapes.body.radius": leaf}, spp=16, edge_spp=64).double().sum() / 48).backward()
    assert leaf.grad is not None and float(leaf.grad) == pytest.approx(2 * math.pi, rel=1e-2)


@pytest.mark.parametrize(
    "body",
    [
        {"type": "sphere", "radius": 0.5, "center": [0, 0, 0.5]},
        {"type": "cube", "transform": [{"scale": 0.5}, {"translate": [0, 0, 0.5]}]},
        {"type": "cylinder", "center": [0, 0.5, 0], "radius": 0.5, "transform": [UPRIGHT]},
        {"type": "cylinder", "center": [0, 0, 0.5], "radius": 0.5},
        {"type": "sphere", "radius": 0.5, "center": [0, 0, 0.7]},
        {"type": "rectangle", "transform": [{"translate": [0, 2.7, 0]}]},
    ],
    ids=["ball", "cube", "cylinder", "lying cylinder", "ball in the air", "rectangle beside"],
)
def test_bodies_that_touch_or_are_apart_do_not_cut(body: dict[str, Any]) -> None:
    scene = scene_of(body)
    bodies = bodies_of(scene, settings(scene.description, {}).film, {})
    assert cuts_of(scene, bodies, scene.merged(None)) is None


#: Bodies that stand through a floor, which a lamp shines on: body, and the entry of its pose.
LIT: dict[str, tuple[dict[str, Any], tuple[int, int]]] = {
    "ball rises": ({"type": "sphere", "radius": 0.6, "center": [0, 0, -0.25]}, (2, 3)),
    "ball aside": ({"type": "sphere", "radius": 0.6, "center": [0, 0, -0.25]}, (0, 3)),
    "post aside": ({"type": "cylinder", "radius": 0.4, "height": 1.4, "transform": [UPRIGHT]}, (0, 3)),
    "cube turns": (
        {"type": "cube", "transform": [{"scale": 0.5}, {"rotate": {"axis": [1, 1, 0], "angle": 30}}]},
        (0, 1),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("depth", [2, 3])
@pytest.mark.parametrize("name", LIT)
def test_reflected_light_agrees_with_differences(name: str, depth: int) -> None:
    body, (row, column) = LIT[name]
    described = {
        "camera": {"type": "perspective", "origin": [1.5, -4, 2.5], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40},
        "film": {"width": 16, "height": 16, "filter": "box"},
        "integrator": {"type": "path", "max_depth": depth},
        "render": {"threads": 1},
        "materials": {"grey": {"type": "diffuse", "reflectance": 0.7}, "dark": {"type": "diffuse", "reflectance": 0.2}},
        "shapes": {
            "floor": {"type": "rectangle", "material": "grey", "transform": [{"scale": 2}]},
            "lamp": {
                "type": "rectangle",
                "material": "dark",
                "emission": [8, 8, 8],
                "flip_normals": True,
                "transform": [{"scale": 0.4}, {"translate": [1, 1, 2]}],
            },
            "body": {"material": "dark", **body},
        },
    }
    scene = torchpt.load(described, "cpu")
    pose = scene.params["shapes.body.to_world"].double()
    unit = torch.zeros_like(pose)
    unit[row, column] = 1.0

    def mean(step: float, seed: int) -> float:
        params = {"shapes.body.to_world": pose + step * unit}
        return float(torchpt.render(scene, params=params, spp=1024, seed=seed).double().mean())

    def gradient(seed: int) -> float:
        leaf = pose.clone().requires_grad_()
        torchpt.render(scene, params={"shapes.body.to_world": leaf}, spp=64, seed=seed).double().mean().backward()
        assert leaf.grad is not None
        return float(leaf.grad[row, column])

    step = 0.05
    differences = torch.tensor([(mean(step, k) - mean(-step, k)) / (2 * step) for k in range(12)], dtype=torch.float64)
    found = torch.tensor([gradient(100 + k) for k in range(24)], dtype=torch.float64)
    error = math.hypot(*(float(x.std()) / math.sqrt(len(x)) for x in (differences, found)))
    expected = float(differences.mean())
    assert abs(float(found.mean()) - expected) < 3.0 * error + 0.01 * abs(expected)
    assert error < 0.03 * abs(expected)
