"""Surfaces that touch, are mirrored, have smooth normals, or textures of any scale."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.stress.case import Case, powers_of_ten
from torchpt.stress.cases._scenes import UNIT_SKY, front_camera, furnace
from torchpt.stress.harness import Harness, relative, relative_difference

__all__ = ["CASES"]

WHITE = {"type": "diffuse", "reflectance": 1.0}


def round_mesh(rings: int, **keys: Any) -> dict[str, Any]:
    """Return a ball of ``rings`` bands of triangles with the normals of a sphere, as a mesh with further ``keys``."""
    polar, around = np.linspace(0, np.pi, rings + 1)[1:-1], np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    belts = [[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in polar for b in around]
    points, per_belt = [[0.0, 0.0, 1.0], *belts, [0.0, 0.0, -1.0]], len(around)  # pole, belts of vertices, pole
    faces = [[0, 1 + k, 1 + (k + 1) % per_belt] for k in range(per_belt)]
    for belt in range(len(polar) - 1):
        upper, lower = 1 + belt * per_belt, 1 + (belt + 1) * per_belt
        for k in range(per_belt):
            after = (k + 1) % per_belt
            faces += [[upper + k, lower + k, lower + after], [upper + k, lower + after, upper + after]]
    last, upper = len(points) - 1, 1 + (len(polar) - 1) * per_belt
    faces += [[last, upper + (k + 1) % per_belt, upper + k] for k in range(per_belt)]
    return {
        "type": "mesh",
        "vertices": np.asarray(points).tolist(),
        "normals": np.asarray(points).tolist(),
        "faces": faces,
        **keys,
    }


def shaded_round(harness: Harness, rings: float) -> float:
    """Return the excess over 1 of coarse balls with smooth normals in a furnace."""
    worst = 0.0
    for material in (WHITE, {"type": "roughconductor", "reflectance": 1.0, "alpha": 0.3}, {"type": "conductor"}):
        scene = {
            "camera": front_camera(width=2.2),
            "shapes": {"it": round_mesh(int(rings), material=material)},
            "lights": UNIT_SKY,
        }
        worst = max(worst, float(harness.render(scene, spp=256, max_depth=-1).mean()) - 1.0)
    return max(worst, 0.0)


def touching(harness: Harness, size: float) -> float:
    """Render touching white boxes on a white floor in a furnace: 1, unless rays are lost where they touch."""
    boxes = {
        f"b{k}": {
            "type": "cube",
            "material": WHITE,
            "transform": [{"scale": size}, {"translate": [2 * size * k, 0, size]}],
        }
        for k in (-1, 0, 1)
    }
    floor = {"type": "rectangle", "material": WHITE, "transform": [{"scale": 10 * size}]}
    camera = {
        "type": "perspective",
        "origin": [size, -6 * size, 6 * size],
        "target": [0, 0, size],
        "up": [0, 0, 1],
        "fov": 30,
    }
    scene = {"camera": camera, "shapes": {**boxes, "floor": floor}, "lights": UNIT_SKY}
    return relative(harness.render(scene, spp=256, max_depth=-1), 1.0)


def mirrored(harness: Harness, scale: float) -> float:
    """Compare emissive shapes with those mirrored in z by a negative scale, whose front stays the front."""
    pictures = []
    for z in (scale, -scale):
        shape = round_mesh(8, emission=1.0, transform=[{"scale": [1, 1, z]}])
        cube = {"type": "cube", "emission": 0.5, "transform": [{"scale": [0.3, 0.3, z]}, {"translate": [2, 0, 0]}]}
        pictures.append(
            harness.render(
                {"camera": front_camera(width=6.0), "shapes": {"it": shape, "cube": cube}}, max_depth=1, size=16
            )
        )
    return relative_difference(*pictures)


def checks(harness: Harness, scale: float) -> float:
    """Return how far the mean radiance of a ball with a checkerboard of black and white lies outside what the squares allow.

    Args:
        harness: device, search and engine of the render.
        scale: squares for each unit of the texture coordinates, along u and along v.
    """
    board = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "scale": [scale, scale]}
    found = float(harness.render(furnace({"type": "diffuse", "reflectance": board}), spp=256, max_depth=2).mean())
    if scale > 1e6:  # float32 cannot tell a square from the next: any mean of the colours is right
        return max(found - 1.0, -found, 0.0)
    if scale < 1e-3:  # the first square, which is black, covers the ball
        return abs(found)
    return max(found - 0.75, 0.25 - found, 0.0)  # half, but for a few large squares


def no_room_for_uv(harness: Harness, span: float) -> float:
    """Return the excess over 1 of an anisotropic metal in a furnace; a dark picture, with light lost, is the figure 1.

    Args:
        harness: device, search and engine of the render.
        span: range of the texture coordinates; so small or large that they may define no tangent frame.
    """
    mesh = round_mesh(6, material={"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4, "reflectance": 1.0})
    mesh["uvs"] = (np.asarray(mesh["vertices"])[:, :2] * span).tolist()
    found = harness.render({"camera": front_camera(width=1.0), "shapes": {"it": mesh}, "lights": UNIT_SKY}, max_depth=2)
    mean = float(found.mean())
    return max(mean - 1.0, 0.0) if mean > 0.5 else 1.0


CASES = (
    Case(
        name="smooth normals gain nothing",
        measures="radiance above 1",
        bound=2e-3,
        figure=shaded_round,
        axis="rings",
        sweep=(2.0, 3.0, 4.0, 8.0, 32.0),
    ),
    Case(
        name="boxes that touch",
        measures="relative to 1",
        bound=2e-3,
        figure=touching,
        axis="size",
        sweep=powers_of_ten(-6, 6, step=3),
    ),
    Case(
        name="mirrored shapes",
        measures="mean difference",
        bound=2e-3,
        figure=mirrored,
        axis="scale",
        sweep=(1e-4, 1e-2, 1.0),
    ),
    Case(
        name="textures of any fineness",
        measures="beyond its colours",
        bound=1e-6,
        figure=checks,
        axis="squares",
        sweep=(*powers_of_ten(-30, 0, step=10), 1e3, 1e6, 1e9, 1e30),
    ),
    Case(
        name="texture coordinates of any span",
        measures="radiance above 1",
        bound=2e-3,
        figure=no_room_for_uv,
        axis="span",
        sweep=(0.0, *powers_of_ten(-30, 30, step=10)),
    ),
)
