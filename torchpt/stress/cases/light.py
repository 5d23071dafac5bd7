"""Lights near and far, dim and bright, few and many; short and long paths.

E is the irradiance of a floor, whose radiance is ``ALBEDO E / π``.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import torch

from torchpt.images import write_image
from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.cases._scenes import UNIT_SKY, floor_seen, front_camera, furnace, room
from torchpt.stress.harness import Harness, relative

__all__ = ["CASES"]

#: Albedo of the floor and of balls: the default of ``floor_seen``.
ALBEDO = 0.5


def lamp(kind: str, height: float, **keys: Any) -> dict[str, Any]:
    """Return a shape at ``height`` that emits down onto the floor."""
    # Flat shapes face +z.
    turn = [{"rotate": {"axis": [1, 0, 0], "angle": 180}}] if kind in ("disk", "rectangle") else []
    return {"lamp": {"type": kind, "emission": 1.0, "transform": [*turn, {"translate": [0, 0, height]}], **keys}}


def disk_above(harness: Harness, height: float) -> float:
    """Compare a one-sided disk of radius 1 with E = π / (1 + h²)."""
    expected = ALBEDO / (1.0 + height**2)
    scene = floor_seen(lights=None, shapes=lamp("disk", height), camera_height=min(1e-3, height / 2))
    return relative(harness.render(scene, spp=256, max_depth=2), expected)


def ball_above(harness: Harness, height: float) -> float:
    """Compare a ball of radius 1, its lowest point at ``height``, with E = π / (1 + h)²."""
    expected = ALBEDO / (1.0 + height) ** 2
    scene = floor_seen(lights=None, shapes=lamp("sphere", 1.0 + height), camera_height=min(1e-3, height / 2))
    return relative(harness.render(scene, spp=256, max_depth=2), expected)


def point_above(harness: Harness, height: float) -> float:
    """Compare a point light with E = I / h²."""
    light = {"it": {"type": "point", "position": [0, 0, height], "intensity": 1.0}}
    return relative(harness.render(floor_seen(lights=light), max_depth=2), ALBEDO / math.pi / height**2)


def inside_a_light(harness: Harness, radius: float) -> float:
    """Compare a floor inside an emissive ball with E = π."""
    ball = {"type": "sphere", "radius": radius, "emission": 1.0, "flip_normals": True}
    return relative(harness.render(floor_seen(lights=None, shapes={"ball": ball}), spp=256, max_depth=2), ALBEDO)


def radiance(harness: Harness, value: float) -> float:
    """Compare a constant environment with ``value`` times the picture of radiance 1."""
    scene = furnace({"type": "diffuse", "reflectance": ALBEDO})
    of_radiance_1 = harness.render(scene)
    return relative(
        harness.render({**scene, "lights": {"sky": {"type": "constant", "radiance": value}}}),
        of_radiance_1.mean() * value,
    )


def area_radiance(harness: Harness, value: float) -> float:
    """Compare an emissive disk of radius 1 and radiance ``value`` at height 1 with E = π value / 2."""
    return relative(
        harness.render(floor_seen(lights=None, shapes=lamp("disk", 1.0, emission=value)), max_depth=2),
        ALBEDO * value / 2,
    )


def many(harness: Harness, number: float) -> float:
    """Compare ``number`` point lights at height 2, of intensity 1 together, with E = 1 / 2²."""
    lights = {f"p{k}": {"type": "point", "position": [0, 0, 2], "intensity": 1.0 / number} for k in range(int(number))}
    return relative(harness.render(floor_seen(lights=lights), max_depth=2), ALBEDO / math.pi / 4)


def one_of_many(harness: Harness, number: float) -> float:
    """Compare ``number`` point lights, one of them a million times brighter, with E = I / 2² of their sum."""
    lights = {f"p{k}": {"type": "point", "position": [0, 0, 2], "intensity": 1e-6} for k in range(int(number) - 1)}
    lights["bright"] = {"type": "point", "position": [0, 0, 2], "intensity": 1.0}
    expected = (1.0 + 1e-6 * (number - 1)) * ALBEDO / math.pi / 4
    return relative(harness.render(floor_seen(lights=lights), max_depth=2, spp=256), expected)


def sun(harness: Harness, value: float) -> float:
    """Compare an environment map of radiance 1 with one texel of radiance ``value`` with its picture in float64."""
    height, width = 64, 128
    texels = torch.ones(height, width, 3)
    texels[height // 4, width // 4] = value
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_image(file, texels)
        scene = furnace({"type": "diffuse", "reflectance": 1.0})
        scene["lights"] = {"sky": {"type": "envmap", "path": str(file)}}
        scene["camera"] = front_camera(width=1e-3)
        found = harness.render(scene, spp=256, max_depth=2)
        exact = harness.exact().render(scene, spp=256, max_depth=2)
    return relative(found, exact)


def black_map(harness: Harness, lit: float) -> float:
    """Compare an environment map that is black but for its first ``lit`` rows with its picture in float64."""
    texels = torch.zeros(16, 32, 3)
    texels[: int(lit)] = 1.0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_image(file, texels)
        scene = furnace({"type": "diffuse", "reflectance": 1.0})
        scene["lights"] = {"sky": {"type": "envmap", "path": str(file)}}
        found, exact = (one.render(scene, max_depth=2) for one in (harness, harness.exact()))
    return relative(found, exact)


def closed_room(harness: Harness, depth: float) -> float:
    """Compare a closed room of albedo 0.9 with the series of ``depth`` terms."""
    expected = (1 - 0.9**depth) / 0.1
    return relative(harness.render(room(0.9), spp=256, max_depth=int(depth)), expected)


def bright_room(harness: Harness, absorbed: float) -> float:
    """Compare a closed room of unbounded paths with 1 / ``absorbed``."""
    return relative(harness.render(room(1.0 - absorbed), spp=64, max_depth=-1), 1.0 / absorbed)


def white_room(harness: Harness, depth: float) -> float:
    """Compare a closed room of albedo 1 with ``depth``: each of that many edges of a path brings the emission 1."""
    return relative(harness.render(room(1.0), spp=16, max_depth=int(depth)), depth)


def nothing(harness: Harness, which: float) -> float:
    """Render scenes without shapes, without light, of a black ball, and from inside it: black, or the sky.

    Args:
        harness: device, search and engine of the render.
        which: index of the scene.
    """
    black = {"type": "diffuse", "reflectance": 0.0}
    scenes = (  # a scene, and the radiance of its picture
        ({"camera": front_camera()}, 0.0),
        ({"camera": front_camera(), "lights": UNIT_SKY}, 1.0),
        ({"camera": front_camera(), "shapes": {"it": {"type": "rectangle"}}}, 0.0),
        (furnace(black), 0.0),
        (furnace(black, radius=50.0), 0.0),
    )
    scene, expected = scenes[int(which)]
    return float((harness.render(scene) - expected).abs().max())


CASES = (
    Case(
        name="a disk of light from so far",
        measures="relative",
        bound=2e-3,
        figure=disk_above,
        axis="height in radii",
        sweep=powers_of_ten(-7, 15),
    ),
    Case(
        name="a ball of light from so far",
        measures="relative",
        bound=2e-3,
        figure=ball_above,
        axis="gap in radii",
        sweep=powers_of_ten(-4, 11),
    ),
    Case(
        name="a point from so far",
        measures="relative",
        bound=1e-4,
        figure=point_above,
        axis="height",
        sweep=powers_of_ten(-2, 15),
    ),
    Case(
        name="inside a light",
        measures="relative",
        bound=2e-2,
        figure=inside_a_light,
        axis="radius",
        sweep=powers_of_ten(1, 9),
    ),
    Case(
        name="radiance of the sky",
        measures="relative to radiance 1",
        bound=1e-5,
        figure=radiance,
        axis="radiance",
        sweep=powers_of_ten(-36, 36, step=4),
    ),
    Case(
        name="radiance of a disk",
        measures="relative",
        bound=5e-3,
        figure=area_radiance,
        axis="radiance",
        sweep=powers_of_ten(-34, 36, step=5),
    ),
    Case(
        name="many lights",
        measures="relative",
        bound=1e-3,
        figure=many,
        axis="lights",
        sweep=(1.0, 10.0, 1e3, 1e5),
        quick_sweep=(1.0, 1e3),
    ),
    Case(
        name="one light a million times brighter",
        measures="relative",
        bound=2e-2,
        figure=one_of_many,
        axis="lights",
        sweep=(2.0, 1e2, 1e4, 1e5),
        quick_sweep=(2.0, 1e2),
    ),
    Case(
        name="a sun in a map, as in float64",
        measures="relative",
        bound=1e-3,
        figure=sun,
        axis="radiance",
        sweep=powers_of_ten(0, 8, step=2),
    ),
    Case(
        name="maps that are black",
        measures="relative",
        bound=1e-3,
        figure=black_map,
        axis="rows that are not",
        sweep=(0.0, 1.0, 15.0),
    ),
    Case(
        name="a closed room",
        measures="relative",
        bound=1e-2,
        figure=closed_room,
        axis="longest path",
        sweep=(1.0, 2.0, 10.0, 100.0, 1000.0),
    ),
    Case(
        name="a room that absorbs little",
        measures="relative",
        bound=5e-2,
        figure=bright_room,
        axis="absorbed",
        sweep=(0.5, 0.1, 1e-2, 1e-3),
    ),
    Case(
        name="a room that absorbs nothing",
        measures="relative",
        bound=5e-2,
        figure=white_room,
        axis="longest path",
        sweep=(1.0, 10.0, 100.0, 1000.0),
    ),
    Case(
        name="nothing to see",
        measures="largest difference",
        bound=1e-6,
        figure=nothing,
        axis="scene",
        sweep=(0.0, 1.0, 2.0, 3.0, 4.0),
    ),
)
