"""Refracting shapes that lie on each other are told of; those with a gap, an opaque neighbour or an edge in common are not."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest

import torchpt

GLASS = {"type": "dielectric", "int_ior": 1.5}
OTHERS = {
    "pane": {"type": "thindielectric"},
    "frosted": {"type": "roughdielectric", "alpha": 0.2},
    "wall": {"type": "diffuse"},
}


def scene(other: dict[str, Any], turn: float = 0.0) -> dict[str, Any]:
    """A glass cube from -1 to 1, and another shape; both turned."""
    turned = {"rotate": {"axis": [1, 2, 3], "angle": turn}}
    shapes = {"one": {"type": "cube", "transform": [turned], "material": "glass"}}
    shapes["other"] = {**other, "transform": [*other.get("transform", []), turned]}
    return {
        "camera": {"type": "perspective", "origin": [0, 0, 9], "target": [0, 0, 0]},
        "materials": {"glass": GLASS, **OTHERS},
        "shapes": shapes,
        "lights": {"sky": {"type": "constant"}},
    }


def beside(gap: float, material: str = "glass", scale: float = 1.0, up: float = 0.0) -> dict[str, Any]:
    transform = [{"scale": scale}, {"translate": [1.0 + scale + gap, up, 0.0]}]
    return {"type": "cube", "material": material, "transform": transform}


def on_top(kind: str, gap: float = 0.0, out: float = 0.0, material: str = "glass", **more: Any) -> dict[str, Any]:
    """A cylinder or cone of radius .5 on the upper face."""
    at = [{"translate": [out, 1.0 + gap, out]}]
    own = {"center": [0, 0.5, 0], "radius": 0.5} if kind == "cylinder" else {"apex": [0, 1, 0], "slope": 0.5}
    return {"type": kind, **own, "material": material, "transform": at, **more}


@pytest.mark.parametrize("turn", [0.0, 33.0])
@pytest.mark.parametrize("far", [0.0, 1e5])
@pytest.mark.parametrize(
    "other",
    [
        beside(0.0),
        beside(0.0, "frosted"),
        beside(0.0, scale=0.3, up=0.4),
        beside(0.0, up=1.99),
        on_top("cylinder"),
        on_top("cone", out=1.3),
        {"type": "disk", "material": "glass", "transform": [{"translate": [0.0, 1.5, 1.0]}]},
    ],
    ids=["face on face", "of another material", "a small one", "by a sliver", "a cylinder", "a cone", "a disk"],
)
def test_two_glass_boxes_that_touch_are_told_of(other, far, turn):
    given = scene(other, turn)
    for shape in given["shapes"].values():
        shape["transform"] = [*shape["transform"], {"translate": [far, -far, far]}]
    with pytest.warns(torchpt.EnergyWarning, match=r"shapes.one: refracts and lies on shapes.other"):
        torchpt.load(given, "cpu")


def test_meshes_and_instances_that_touch_are_told_of():
    corners = [[1, -3, -3], [1, 3, -3], [1, 0, 4]]
    given = scene({"type": "mesh", "vertices": corners, "faces": [[0, 1, 2]], "material": "glass"})
    with pytest.warns(torchpt.EnergyWarning, match="shapes.other"):
        torchpt.load(given, "cpu")
    grid = np.stack(np.meshgrid(np.arange(40), np.arange(40), indexing="ij"), -1).reshape(-1, 2)
    faces = [[k, k + 1, k + 40] for k in range(1500) if k % 40 < 39]
    flat = {"type": "mesh", "vertices": [[x, y, 0] for x, y in grid.tolist()], "faces": faces, "material": "glass"}
    given = scene({**flat, "transform": [{"translate": [50, 0, 0]}]})
    given["shapes"]["copy"] = {"type": "instance", "of": "other", "transform": [{"translate": [50.3, 0.2, 0]}]}
    with pytest.warns(torchpt.EnergyWarning, match="shapes.copy"):
        torchpt.load(given, "cpu")


@pytest.mark.parametrize(
    "other",
    [
        beside(1e-3),
        beside(-0.1, scale=0.3),
        beside(0.0, "wall"),
        beside(0.0, "pane"),
        beside(0.0, up=2.0),
        {"type": "sphere", "center": [2, 0, 0], "radius": 1.0, "material": "glass"},
        on_top("cylinder", gap=1e-3),
        on_top("cylinder", out=1.36),  # its cap passes the corner by .009
        on_top("cylinder", capped=False),
        on_top("cylinder", material="wall"),
    ],
    ids=[
        *("a gap", "overlapping", "opaque", "a thin pane", "an edge in common", "a sphere"),
        *("a cylinder above", "a cylinder past the corner", "an open cylinder", "an opaque cylinder"),
    ],
)
def test_others_are_not(other):
    if "transform" not in other:
        other = {**other, "transform": []}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchpt.load(scene(other, 20.0), "cpu")


def test_what_it_warns_of_is_real():
    """Two cubes in a white furnace shine by more than 1 where they touch; with a gap they do not."""

    def worst(gap: float) -> float:
        given = scene(beside(gap))
        given["camera"] |= {"origin": [-7, 1.2, 1.3], "target": [1, 0, 0], "fov": 30}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", torchpt.EnergyWarning)
            loaded = torchpt.load(given, "cpu")
        wish = {"film": {"width": 24, "height": 24}, "integrator": {"type": "path", "max_depth": -1}}
        return float(torchpt.render(loaded, spp=64, accel="numba", **wish).max())

    assert worst(0.0) > 1.05
    assert math.isclose(worst(1e-3), 1.0, rel_tol=2e-3)
