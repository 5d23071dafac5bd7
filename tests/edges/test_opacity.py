"""Edges of, before and behind surfaces that are not opaque, in closed form."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few

import torchpt

SUN = {"sun": {"type": "directional", "direction": [-0.3, 0, -1], "irradiance": [1, 1, 1]}}


def veil(opacity: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": 0, "opacity": opacity}


def by_x(described: dict[str, Any], name: str, weight: torch.Tensor | float = 1.0, **wish: Any) -> float:
    """Return the derivative of a weighted sum of pixels by the place of something along x."""
    scene = torchpt.load(described, "cpu")
    leaf = scene.params[name].double().requires_grad_()
    picture = torchpt.render(scene, params={name: leaf}, **wish).double()
    (picture * weight).sum().backward()
    assert leaf.grad is not None
    return float(leaf.grad[0, 3])


@pytest.mark.parametrize(("moving", "still"), few([(0.5, None), (0.5, 0.5), (0.3, 0.6)], 2))
def test_shadows_fall_through_what_is_not_opaque(moving: float, still: float | None) -> None:
    """A veil moves in the sun, above another one: what its shadow takes is its own opacity of what the other lets pass."""
    pane = [{"scale": 8}, {"translate": [0, 0, 1.5]}]
    shapes = {
        "floor": {
            "type": "rectangle",
            "material": {"type": "diffuse", "reflectance": 0.5},
            "transform": [{"scale": 9}],
        },
        "it": {
            "type": "rectangle",
            "material": veil(moving),
            "transform": [{"scale": 0.5}, {"translate": [0.6, 0, 2]}],
        },
    }
    if still is not None:
        shapes["pane"] = {"type": "rectangle", "material": veil(still), "transform": pane}
    camera = {"type": "orthographic", "origin": [0, 0, 1], "target": [0, 0, 0], "up": [0, 1, 0], "width": 4}
    film = {"width": 8, "height": 8, "filter": "box"}
    described = {"camera": camera, "film": film, "integrator": {"max_depth": 2}, "lights": SUN, "shapes": shapes}
    weight = torch.zeros(8, 8, 1, dtype=torch.float64)
    weight[:, 4:] = 1.0  # the shadow's border runs over the middle of the film, of one unit of length
    found = [by_x(described, "shapes.it.to_world", weight, spp=8, edge_spp=256, seed=seed) for seed in range(6)]
    lit = 0.5 / math.pi * 3 * 4 / math.sqrt(1.09)  # of three channels, and four pixels for a unit of area
    expected = -lit * moving * (1.0 if still is None else 1.0 - still)
    mean, error = torch.tensor(found).mean(), torch.tensor(found).std() / math.sqrt(len(found))
    assert abs(float(mean) - expected) < 4.5 * float(error)
    assert float(error) < 0.1 * abs(expected)


@pytest.mark.parametrize("pane", [None, {"opacity": 0.001}, {"opacity": 0.5}, "blend"])
@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_a_seam_behind_a_veil_counts_once(pane: dict[str, float] | str | None) -> None:
    """Two lamps have a border in common, and the camera moves: what is seen through a veil is the veil's part of it."""
    black = {"type": "diffuse", "reflectance": 0}
    shapes: dict[str, Any] = {
        "left": {"emission": [1, 1, 1], "transform": [{"scale": 2}, {"translate": [-2.13, 0, 0]}]},
        "right": {"emission": [3, 3, 3], "transform": [{"scale": 2}, {"translate": [1.87, 0, 0]}]},
    }
    if pane is not None:
        null = {"type": "blend", "a": {"type": "null"}, "b": black, "weight": 0.5}
        material = null if isinstance(pane, str) else {**black, **pane}
        shapes["pane"] = {"material": material, "transform": [{"scale": 3}, {"translate": [0, 0, 2]}]}
    described = {
        "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 30},
        "film": {"width": 8, "height": 8, "filter": "box"},
        "integrator": {"max_depth": 1},
        "shapes": {name: {"type": "rectangle", "material": black, **shape} for name, shape in shapes.items()},
    }
    found = by_x(described, "camera.to_world", spp=4, edge_spp=512)
    passes = 1.0 if pane is None else 0.5 if isinstance(pane, str) else 1.0 - pane["opacity"]
    # Eight rows of a seam of step 2 in three channels, at a distance of 4 whose film is 8 pixels wide.
    expected = 2 * 3 * 8 * 8 / (2 * 4 * math.tan(math.radians(15)))
    assert found == pytest.approx(passes * expected, rel=0.02)


@pytest.mark.filterwarnings("ignore::torchpt.EdgeWarning")
def test_what_is_hardly_there_has_hardly_edges() -> None:
    """Of a body that is shaded smooth every edge fades with its opacity: silhouettes, shadows, horizons."""
    around, step = 8, 2 * math.pi / 8
    ring = [[math.cos(k * step), 0.3, math.sin(k * step)] for k in range(around)]
    faces = [[0, 1 + (k + 1) % around, 1 + k] for k in range(around)]
    found = {}
    for opacity in (0.5, 0.005):
        tent = {"type": "mesh", "vertices": [[0, 0.9, 0], *ring], "faces": faces}
        tent |= {"material": {"type": "diffuse", "reflectance": 0.6, "opacity": opacity}}
        floor = {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]}
        described = {
            "camera": {"origin": [0, 2.5, 4], "target": [0, 0.3, 0], "fov": 40},
            "film": {"width": 12, "height": 12, "filter": "box"},
            "integrator": {"max_depth": 3},
            "lights": {
                "sun": {"type": "directional", "direction": [-0.8, -0.5, 0.1], "irradiance": 2},
                "sky": {"type": "constant"},
            },
            "shapes": {"it": tent, "floor": floor},
        }
        weight = torch.linspace(0, 1, 12, dtype=torch.float64)[None, :, None]
        found[opacity] = by_x(described, "shapes.it.to_world", weight, spp=16, edge_spp=64)
    assert abs(found[0.005]) < 0.04 * abs(found[0.5])
