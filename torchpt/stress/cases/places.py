"""Sizes, distances, and shapes that nearly are none."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.rendering.api import render
from torchpt.scene import load
from torchpt.stress.case import Case, powers
from torchpt.stress.cases._scenes import SKY, ball, facing, furnace
from torchpt.stress.harness import Harness, relative, relative_difference

__all__ = ["CASES"]

WHITE = {"type": "diffuse", "reflectance": 1.0}


def still_life(scale: float = 1.0, shift: float = 0.0, turn: float = 0.0) -> dict[str, Any]:
    """A floor, a ball, a box and a lamp, scaled, turned about x, and shifted along what is no axis."""
    step = [shift, 0.7 * shift, -0.3 * shift]
    moved = [{"rotate": {"axis": [1, 0, 0], "angle": turn}}, {"scale": scale}, {"translate": step}]

    def put(**keys: Any) -> dict[str, Any]:
        return {**keys, "transform": [*keys.get("transform", []), *moved]}

    angle = np.radians(turn)
    spin = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])

    def place(x: float, y: float, z: float) -> list[float]:
        return (scale * (spin @ [x, y, z]) + step).tolist()

    return {
        "camera": {
            "type": "perspective",
            "origin": place(0, 2, 6),
            "target": place(0, 0.5, 0),
            "up": (spin @ [0, 1, 0]).tolist(),
            "fov": 40,
        },
        "shapes": {
            "floor": put(type="rectangle", transform=[{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]),
            "ball": put(
                type="sphere", radius=0.7, center=[-1, 0.7, 0], material={"type": "roughplastic", "alpha": 0.2}
            ),
            "box": put(type="cube", transform=[{"scale": 0.5}, {"translate": [1, 0.5, 0]}]),
            "lamp": put(type="sphere", radius=0.3, center=[0, 3, 1], emission=10.0),
        },
    }


def at_scale(harness: Harness, scale: float) -> float:
    """The picture of a scene of another size."""
    return relative_difference(
        harness.render(still_life(scale), size=24, spp=16), harness.render(still_life(), size=24, spp=16)
    )


def far_away(harness: Harness, shift: float) -> float:
    """The picture of a scene far from the origin."""
    return relative_difference(
        harness.render(still_life(shift=shift), size=24, spp=16), harness.render(still_life(), size=24, spp=16)
    )


def turned(harness: Harness, angle: float) -> float:
    """The picture of a scene that is turned with its camera. Its frames, and so its noise, are others."""
    plain, other = (harness.render(still_life(), size=24, spp=64, seed=seed) for seed in (1, 2))
    return relative_difference(harness.render(still_life(turn=angle), size=24, spp=64), plain) / relative_difference(
        other, plain
    )


def little_on_large(harness: Harness, radius: float) -> float:
    """A white ball on a white floor of 1e3 under white light: a ray that starts inside of what it left darkens it."""
    scene = {
        "camera": {"type": "perspective", "origin": [0, 6 * radius, 3 * radius], "target": [0, 0, radius], "up": [0, 0, 1],
                   "fov": 20},
        "shapes": {"floor": {"type": "rectangle", "material": WHITE, "transform": [{"scale": 1e3}]},
                   "ball": ball(radius, (0.0, 0.0, radius), material=WHITE)},
        "lights": SKY,
    }  # fmt: skip
    return relative(harness.render(scene, spp=64, max_depth=-1), 1.0)


def flat_room(harness: Harness, height: float) -> float:
    """A closed room so low, whose walls shine 1 and give back half: 2 wherever one looks, or something leaked."""
    walls = {"type": "cube", "flip_normals": True, "emission": 1.0, "material": {"type": "diffuse", "reflectance": 0.5}}
    scene = {
        "camera": {
            "type": "perspective",
            "origin": [0, 0, 0],
            "target": [0.3, 0.2, height],
            "up": [0, 1, 0],
            "fov": 60,
        },
        "shapes": {"room": {**walls, "transform": [{"scale": [1, 1, height]}]}},
    }
    return relative(harness.render(scene, spp=256, max_depth=-1), 2.0)


def grid(number: int, material: dict[str, Any] = WHITE, **keys: Any) -> dict[str, Any]:
    """A square of ``2 number²`` triangles."""
    x = np.linspace(-1, 1, number + 1)
    points = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((number + 1,) * 2)], -1).reshape(-1, 3)
    first = (np.arange(number)[:, None] * (number + 1) + np.arange(number)).reshape(-1)
    corners = np.stack((first, first + number + 1, first + number + 2, first + 1), 1)
    return {"type": "mesh", "vertices": points.tolist(), "faces": corners.tolist(), "material": material, **keys}


def seams(harness: Harness, number: float) -> float:
    """Black light passes where a square of many triangles leaks at an edge that they share."""
    scene = {"camera": facing(1.9), "shapes": {"square": grid(int(number), emission=1.0)}}
    return float((harness.render(scene, size=64, spp=16, max_depth=1) - 1.0).abs().max())


def degenerate(harness: Harness, _: float) -> float:
    """Slivers and triangles of no area among the others change nothing."""
    plain = grid(8)
    bad = {**plain, "vertices": [*plain["vertices"], [0, 0, 0], [1, 1, 0], [0.5, 0.5, 0], [0, 0, 1e-30], [1e-38, 0, 0]]}
    n = len(plain["vertices"])
    bad["faces"] = [*plain["faces"], [n, n + 1, n + 2], [n, n, n], [n, n + 3, n + 4], [0, 0, 1]]
    pictures = [harness.render({"camera": facing(), "shapes": {"it": it}, "lights": SKY}) for it in (bad, plain)]
    return relative_difference(*pictures)


def all_in_one_place(harness: Harness, number: float) -> float:
    """So many triangles with one centroid: all Morton codes are equal, and the first of them is met."""
    three = [[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [0.0, 6.0, 0.0]]
    mesh = {"type": "mesh", "vertices": three, "faces": [[0, 1, 2]] * int(number), "material": WHITE}
    one = {**mesh, "faces": [[0, 1, 2]]}
    return relative_difference(
        *(harness.render({"camera": facing(), "shapes": {"it": it}, "lights": SKY}, spp=4) for it in (mesh, one))
    )


def along_the_axes(harness: Harness, axis: float) -> float:
    """Rays that are parallel to an axis and lie in planes of boxes."""
    way = [0.0, 0.0, 0.0]
    way[int(axis) % 3] = 4.0 if axis < 3 else -4.0
    up = [0.0, 1.0, 0.0] if int(axis) % 3 != 1 else [1.0, 0.0, 0.0]
    camera = {"type": "orthographic", "origin": way, "target": [0, 0, 0], "up": up, "width": 2.0}
    cubes = {f"c{k}": {"type": "cube", "emission": 1.0, "transform": [{"scale": 0.5}, {"translate": p}]}
             for k, p in enumerate(([-0.5, -0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [0.5, 0.5, 0.5]))}  # fmt: skip
    return float((harness.render({"camera": camera, "shapes": cubes}, size=16, spp=16, max_depth=1) - 1.0).abs().max())


def small_far_sphere(harness: Harness, distance: float) -> float:
    """A ball lit from the eye, so far away: its discriminant is a small difference of large numbers."""
    half = np.arctan(1.0 / distance) / 2
    scene = {
        "camera": {
            "type": "perspective",
            "origin": [0, 0, distance],
            "target": [0, 0, 0],
            "fov": float(np.degrees(2 * half)),
        },
        "shapes": {"ball": ball(1.0, material=WHITE)},
        "lights": {"sun": {"type": "directional", "direction": [0, 0, -1], "irradiance": np.pi}},
    }
    middles = (np.arange(256) + 0.5) / 128 - 1
    x, y = np.meshgrid(middles * np.tan(half), middles * np.tan(half))
    # Along (x, y, -1): the nearer root, in a form without a difference of large numbers.
    a, outside = x * x + y * y + 1, (distance - 1) * (distance + 1)
    z = distance - outside / (distance + np.sqrt(distance * distance - a * outside))
    return relative(harness.render(scene, spp=256, max_depth=2), float(z.mean()))


def one_pixel_wide(harness: Harness, width: float) -> float:
    """A film of so many pixels by one."""
    scene = load(furnace({"type": "diffuse"}, emission=0.5), device=harness.device)
    film = {"width": int(width), "height": 1, "filter": "box"}
    only = {"type": "path", "max_depth": 1}
    picture = render(scene, film=film, spp=1, integrator=only, accel=harness.accel, compile=harness.compile)
    return float(picture.shape != (1, int(width), 3)) + relative(picture.double()[:, int(width) // 2], 0.5)


CASES = (
    Case("scale", "mean difference", 2e-3, at_scale, "scale", powers(-18, 18, 2)),
    Case("distance from the origin", "mean difference", 5e-3, far_away, "distance", (0.0, *powers(0, 9))),
    Case("turned", "mean difference over that of another seed", 1.2, turned, "degrees", (90.0, 37.0, 180.0, 1e-3)),
    Case("little things on large ones", "relative to 1", 2e-3, little_on_large, "radius", powers(-3, 1)),
    Case("low rooms", "relative to 2", 2e-3, flat_room, "height", powers(-10, 0)),
    Case("shared edges", "largest leak", 0.0, seams, "cells a side", (1.0, 7.0, 64.0, 200.0)),
    Case("triangles without area", "mean difference", 1e-6, degenerate),
    Case("triangles in one place", "mean difference to one", 0.0, all_in_one_place, "triangles", (2.0, 1e2, 1e4)),
    Case("rays along the axes", "largest leak", 0.0, along_the_axes, "axis", (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)),
    Case("small far spheres", "relative", 1e-3, small_far_sphere, "distance in radii", powers(1, 6)),
    Case("films one pixel high", "relative", 1e-7, one_pixel_wide, "width", (1.0, 2.0, 1023.0, 16384.0)),
)
