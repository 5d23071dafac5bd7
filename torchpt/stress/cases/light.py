"""Lights near and far, dim and bright, few and many; paths long and short."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import torch

from torchpt.images import write_image
from torchpt.stress.case import Case, powers
from torchpt.stress.cases._scenes import SKY, facing, floor_seen, furnace, room
from torchpt.stress.harness import Harness, relative

__all__ = ["CASES"]

ALBEDO = 0.5


def lamp(kind: str, height: float, **keys: Any) -> dict[str, Any]:
    """A shape that shines down from so far above the floor."""
    turn = [{"rotate": {"axis": [1, 0, 0], "angle": 180}}] if kind in ("disk", "rectangle") else []
    return {"lamp": {"type": kind, "emission": 1.0, "transform": [*turn, {"translate": [0, 0, height]}], **keys}}


def disk_above(harness: Harness, height: float) -> float:
    """A disk of radius 1, one-sided: E = π / (1 + h²)."""
    expected = ALBEDO / (1.0 + height**2)
    scene = floor_seen(None, lamp("disk", height), near=min(1e-3, height / 2))
    return relative(harness.render(scene, spp=256, max_depth=2), expected)


def ball_above(harness: Harness, height: float) -> float:
    """A ball of radius 1 whose lowest point is so far up: E = π / (1 + h)²."""
    expected = ALBEDO / (1.0 + height) ** 2
    scene = floor_seen(None, lamp("sphere", 1.0 + height), near=min(1e-3, height / 2))
    return relative(harness.render(scene, spp=256, max_depth=2), expected)


def point_above(harness: Harness, height: float) -> float:
    """A point: E = I / h²."""
    light = {"it": {"type": "point", "position": [0, 0, height], "intensity": 1.0}}
    return relative(harness.render(floor_seen(light), max_depth=2), ALBEDO / math.pi / height**2)


def inside_a_light(harness: Harness, radius: float) -> float:
    """A floor within a ball that shines inwards receives π."""
    ball = {"type": "sphere", "radius": radius, "emission": 1.0, "flip_normals": True}
    return relative(harness.render(floor_seen(None, {"ball": ball}), spp=256, max_depth=2), ALBEDO)


def radiance(harness: Harness, value: float) -> float:
    """Light from everywhere of any strength: so many times the picture of strength 1."""
    scene = furnace({"type": "diffuse", "reflectance": ALBEDO})
    one = harness.render(scene)
    return relative(
        harness.render({**scene, "lights": {"sky": {"type": "constant", "radiance": value}}}), one.mean() * value
    )


def area_radiance(harness: Harness, value: float) -> float:
    """The same of a disk."""
    return relative(
        harness.render(floor_seen(None, lamp("disk", 1.0, emission=value)), max_depth=2), ALBEDO * value / 2
    )


def many(harness: Harness, number: float) -> float:
    """So many points that share the power of one."""
    lights = {f"p{k}": {"type": "point", "position": [0, 0, 2], "intensity": 1.0 / number} for k in range(int(number))}
    return relative(harness.render(floor_seen(lights), max_depth=2), ALBEDO / math.pi / 4)


def one_of_many(harness: Harness, number: float) -> float:
    """So many points of which one is a million times brighter."""
    lights = {f"p{k}": {"type": "point", "position": [0, 0, 2], "intensity": 1e-6} for k in range(int(number) - 1)}
    lights["bright"] = {"type": "point", "position": [0, 0, 2], "intensity": 1.0}
    expected = (1.0 + 1e-6 * (number - 1)) * ALBEDO / math.pi / 4
    return relative(harness.render(floor_seen(lights), max_depth=2, spp=256), expected)


def sun(harness: Harness, value: float) -> float:
    """A map with one texel of this radiance straight above, else 1: half of its power, by its cosine and solid angle."""
    height, width = 64, 128
    texels = torch.ones(height, width, 3)
    row, column = 16, 32
    texels[row, column] = value
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_image(file, texels)
        scene = furnace({"type": "diffuse", "reflectance": 1.0})
        scene["lights"] = {"sky": {"type": "envmap", "path": str(file)}}
        scene["camera"] = facing(1e-3)
        found = harness.render(scene, spp=256, max_depth=2)
        exact = harness.exact().render(scene, spp=256, max_depth=2)
    return relative(found, exact)


def black_map(harness: Harness, lit: float) -> float:
    """A map that is black but for so many rows."""
    texels = torch.zeros(16, 32, 3)
    texels[: int(lit)] = 1.0
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "sky.exr"
        write_image(file, texels)
        scene = furnace({"type": "diffuse", "reflectance": 1.0})
        scene["lights"] = {"sky": {"type": "envmap", "path": str(file)}}
        found, exact = (b.render(scene, max_depth=2) for b in (harness, harness.exact()))
    return relative(found, exact)


def closed_room(harness: Harness, depth: float) -> float:
    """A room of albedo .9: the series of so many terms."""
    expected = (1 - 0.9**depth) / 0.1
    return relative(harness.render(room(0.9), spp=256, max_depth=int(depth)), expected)


def bright_room(harness: Harness, absorbed: float) -> float:
    """A room whose walls absorb so little, paths without end: 1 over that."""
    return relative(harness.render(room(1.0 - absorbed), spp=64, max_depth=-1), 1.0 / absorbed)


def white_room(harness: Harness, depth: float) -> float:
    """A room of albedo 1: as many as there are edges."""
    return relative(harness.render(room(1.0), spp=16, max_depth=int(depth)), depth)


def nothing(harness: Harness, which: float) -> float:
    """Scenes without shapes, without light, and a camera in a solid: black or the sky, to the bit."""
    black = {"type": "diffuse", "reflectance": 0.0}
    scenes = (
        ({"camera": facing()}, 0.0),
        ({"camera": facing(), "lights": SKY}, 1.0),
        ({"camera": facing(), "shapes": {"it": {"type": "rectangle"}}}, 0.0),
        ({**furnace(black)}, 0.0),
        ({**furnace(black, radius=50.0)}, 0.0),
    )
    scene, expected = scenes[int(which)]
    return float((harness.render(scene) - expected).abs().max())


CASES = (
    Case("a disk of light from so far", "relative", 2e-3, disk_above, "height in radii", powers(-7, 15)),
    Case("a ball of light from so far", "relative", 2e-3, ball_above, "gap in radii", powers(-4, 11)),
    Case("a point from so far", "relative", 1e-4, point_above, "height", powers(-2, 15)),
    Case("inside a light", "relative", 2e-2, inside_a_light, "radius", powers(1, 9)),
    Case("radiance of the sky", "relative to radiance 1", 1e-5, radiance, "radiance", powers(-36, 36, 4)),
    Case("radiance of a disk", "relative", 5e-3, area_radiance, "radiance", powers(-34, 36, 5)),
    Case("many lights", "relative", 1e-3, many, "lights", (1.0, 10.0, 1e3, 1e5), (1.0, 1e3)),
    Case(
        "one light a million times brighter", "relative", 2e-2, one_of_many, "lights", (2.0, 1e2, 1e4, 1e5), (2.0, 1e2)
    ),
    Case("a sun in a map, as in float64", "relative", 1e-3, sun, "radiance", powers(0, 8, 2)),
    Case("maps that are black", "relative", 1e-3, black_map, "rows that are not", (0.0, 1.0, 15.0)),
    Case("a closed room", "relative", 1e-2, closed_room, "longest path", (1.0, 2.0, 10.0, 100.0, 1000.0)),
    Case("a room that absorbs little", "relative", 5e-2, bright_room, "absorbed", (0.5, 0.1, 1e-2, 1e-3)),
    Case("a room that absorbs nothing", "relative", 5e-2, white_room, "longest path", (1.0, 10.0, 100.0, 1000.0)),
    Case("nothing to see", "largest difference", 1e-6, nothing, "scene", (0.0, 1.0, 2.0, 3.0, 4.0)),
)
