"""Gradients of shadows that move over a floor, in closed form or against central differences."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few

import torchpt

FLOOR = {"type": "rectangle", "material": "grey", "transform": [{"scale": 9}]}
BASE: dict[str, Any] = {
    # From below the blocker, so that it is not in view: the floor alone, 4 wide.
    "camera": {"type": "orthographic", "origin": [0, 0, 1], "target": [0, 0, 0], "up": [0, 1, 0], "width": 4},
    "film": {"width": 8, "height": 8, "filter": "box"},
    "integrator": {"type": "path", "max_depth": 2},
    "render": {"threads": 1},
    "materials": {"grey": {"type": "diffuse", "reflectance": 0.5}, "black": {"type": "diffuse", "reflectance": 0}},
}
SUN = {"sun": {"type": "directional", "direction": [-0.3, 0, -1], "irradiance": [1, 1, 1]}}
LAMP = {"lamp": {"type": "point", "position": [0, 0, 4], "intensity": [16, 16, 16]}}


def scene_of(lights: dict[str, Any], blocker: dict[str, Any], **more: Any) -> torchpt.Scene:
    shapes = {"floor": FLOOR, "it": {"material": "black", **blocker}}
    return torchpt.load({**BASE, **more, "lights": lights, "shapes": {**shapes, **more.get("shapes", {})}}, "cpu")


def slope(scene: torchpt.Scene, name: str, weight: torch.Tensor | None = None, **wish: Any) -> torch.Tensor:
    """The gradient of the picture's integral over the floor."""
    leaf = scene.params[name].double().requires_grad_()
    wish = {"spp": 8, "edge_spp": 32, **wish}
    picture = torchpt.render(scene, params={name: leaf}, **wish).double()
    ((picture if weight is None else picture * weight).sum() / 4).backward()
    assert leaf.grad is not None
    return leaf.grad


def test_a_blocker_under_the_sun() -> None:
    # A square of side 1 at height 2: along x its edges' shadows keep their lengths.
    blocker = {"type": "rectangle", "transform": [{"scale": 0.5}, {"translate": [0.6, 0, 2]}]}
    scene = scene_of(SUN, blocker)
    lit = 0.5 / math.pi * 3 / math.sqrt(1.09)  # radiance of the lit floor, all channels
    found = slope(scene, "shapes.it.to_world")
    assert float(found[0, 0]) == pytest.approx(-2 * lit, rel=1e-2)  # 0.5 is half the width: the area grows by 2 for 1
    assert abs(float(found[0, 3])) < 1e-2  # what one edge takes the other gives
    # Only the right half of the floor counts: the shadow, about 0, is half in it, and moves into it by 1 for 1.
    weight = torch.zeros(8, 8, 1, dtype=torch.float64)
    weight[:, 4:] = 1.0
    assert float(slope(scene, "shapes.it.to_world", weight)[0, 3]) == pytest.approx(-lit, rel=1e-2)
    # As the sun turns, the shadow moves by the blocker's height; the floor's own cosine is the interior's.
    along = float(slope(scene, "lights.sun.direction", weight)[0])
    cosine = 0.5 / math.pi * 3 * 0.3 / 1.09**1.5 * (2 * 4 - 0.5)  # over what is lit of the right half
    assert along == pytest.approx(-2 * lit + cosine, abs=1e-2 * lit)


@pytest.mark.parametrize(
    ("blocker", "area"),
    few(
        [
            ({"type": "sphere", "radius": 0.5}, math.pi * 0.25),
            ({"type": "disk", "transform": [{"scale": 0.5}]}, math.pi * 0.25),
            ({"type": "cube", "transform": [{"scale": 0.5}]}, 1.0),
            ({"type": "sphere", "transform": [{"scale": [0.5, 0.7, 0.3]}]}, math.pi * 0.35),
            ({"type": "cylinder", "radius": 0.4, "height": 1.5}, 1.2),
            ({"type": "cone", "apex": [0, 0.7, 0], "height": -1.4, "slope": 0.5}, 0.98),
        ],
        1,
    ),
    ids=["sphere", "disk", "cube", "ellipsoid", "cylinder", "cone"],
)
def test_blockers_that_grow_under_the_sun(blocker: dict[str, Any], area: float) -> None:
    straight = {"sun": {**SUN["sun"], "direction": [0, 0, -1]}}
    shape = {**blocker, "transform": [*blocker.get("transform", []), {"translate": [0, 0, 3]}]}
    scene = scene_of(straight, shape)
    pose = scene.params["shapes.it.to_world"].double()
    # Two edges of a cube throw one shadow; the upper one counts.
    found = float((slope(scene, "shapes.it.to_world") * pose)[:3, :3].sum())
    assert found == pytest.approx(-2 * area * 0.5 / math.pi * 3, rel=1e-2)


def test_a_blocker_that_rises_toward_a_lamp() -> None:
    # A disk of radius r at height h below a lamp at 4 throws a shadow of radius R = 4 r / (4 - h).
    blocker = {"type": "disk", "transform": [{"scale": 0.5}, {"translate": [0, 0, 2]}]}
    found = float(slope(scene_of(LAMP, blocker), "shapes.it.to_world")[2, 3])
    radius, grows = 1.0, 4 * 0.5 / (4 - 2) ** 2
    radiance = 3 * 0.5 / math.pi * 16 * 4 / (16 + radius**2) ** 1.5
    assert found == pytest.approx(-2 * math.pi * radius * grows * radiance, rel=1e-2)


#: What moves, which entry, and how deep paths go.
CASES: dict[str, tuple[str, tuple[int, ...], int]] = {
    "lamp": ("lights.lamp.position", (0,), 2),
    "camera": ("camera.to_world", (0, 3), 2),
    "floor": ("shapes.floor.to_world", (2, 3), 2),
    "bounces": ("shapes.it.to_world", (0, 3), 3),
}


def turned(*axis: float, angle: float) -> dict[str, Any]:
    return {"rotate": {"axis": list(axis), "angle": angle}}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_agrees_with_central_differences(case: str) -> None:
    name, entry, depth = CASES[case]
    step, place = 0.05, [{"scale": 0.4}, turned(1, 2, 3, angle=40), {"translate": [0.3, 0, 2]}]
    cube = {"type": "cube", "transform": place}
    leaning = [{"scale": 9}, turned(0, 1, 0, angle=70), {"translate": [-3, 0, 0]}]
    wall = {"type": "rectangle", "material": "grey", "transform": leaning}
    lamp = {"lamp": {**LAMP["lamp"], "position": [1, 0.5, 5]}}
    scene = scene_of(
        lamp, cube, integrator={"type": "path", "max_depth": depth, "rr_depth": 100}, shapes={"wall": wall}
    )
    tall = torch.linspace(0.0, 1.0, 8, dtype=torch.float64)
    weight = (0.3 + torch.sin(3 * tall)[:, None] * torch.cos(2 * tall)[None])[..., None]
    base, shift = scene.params[name].double(), torch.zeros_like(scene.params[name]).double()
    shift[entry] = step
    exact, difference = [], []
    for seed in range(6):
        wish = {"spp": 256, "edge_spp": 1024, "seed": seed, "film": {"filter": "gaussian"}}
        exact.append(slope(scene, name, weight, **wish)[entry])
        ends = [torchpt.render(scene, params={name: base + s * shift}, **{**wish, "spp": 8192}) for s in (1, -1)]  # pyright: ignore
        difference.append(((ends[0] - ends[1]).double() * weight).sum() / 4 / (2 * step))
    a, b = torch.stack(exact), torch.stack(difference)
    error = float((a.var() / 6 + b.var() / 6).sqrt())
    assert abs(float(a.mean() - b.mean())) < 3.5 * error + 0.02 * abs(float(b.mean()))
    assert float(a.std()) / 6**0.5 < 0.1 * abs(float(b.mean()))


def test_a_blocker_under_a_map_with_a_sun() -> None:
    """Edges draw directions of a map alone, however the integrator does: such a map has a density for MIS of its own."""
    texels = torch.full((32, 64, 3), 0.02)
    texels[14:16, 32:34] = 40.0  # from above
    light = {"sky": {"type": "envmap", "data": texels.tolist()}}
    blocker = {"type": "rectangle", "transform": [{"scale": 0.5}, {"translate": [0.3, 0.2, 1]}]}
    weight = torch.zeros(8, 8, 1, dtype=torch.float64)
    weight[:, 4:] = 1.0
    found = []
    for strategy in ("mis", "light"):
        scene = scene_of(light, blocker, integrator={"type": "path", "max_depth": 2, "strategy": strategy})
        found.append(slope(scene, "shapes.it.to_world", weight, spp=64, edge_spp=128)[0, 3])
    assert abs(float(found[0])) > 0.5
    assert float(found[0]) == pytest.approx(float(found[1]), rel=0.03)
