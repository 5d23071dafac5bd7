"""Surfaces that touch, mirror, are shaded as if they were round, or wear textures of any size."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.stress.case import Case, powers
from torchpt.stress.cases._scenes import SKY, facing, furnace
from torchpt.stress.harness import Harness, relative, relative_difference

__all__ = ["CASES"]

WHITE = {"type": "diffuse", "reflectance": 1.0}


def round_mesh(rings: int, **keys: Any) -> dict[str, Any]:
    """A ball of few triangles with the normals of a round one."""
    polar, around = np.linspace(0, np.pi, rings + 1)[1:-1], np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    belts = [[np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)] for a in polar for b in around]
    points, wide = [[0.0, 0.0, 1.0], *belts, [0.0, 0.0, -1.0]], len(around)
    faces = [[0, 1 + k, 1 + (k + 1) % wide] for k in range(wide)]
    for belt in range(len(polar) - 1):
        upper, lower = 1 + belt * wide, 1 + (belt + 1) * wide
        for k in range(wide):
            n = (k + 1) % wide
            faces += [[upper + k, lower + k, lower + n], [upper + k, lower + n, upper + n]]
    last, upper = len(points) - 1, 1 + (len(polar) - 1) * wide
    faces += [[last, upper + (k + 1) % wide, upper + k] for k in range(wide)]
    return {
        "type": "mesh",
        "vertices": np.asarray(points).tolist(),
        "normals": np.asarray(points).tolist(),
        "faces": faces,
        **keys,
    }


def shaded_round(harness: Harness, rings: float) -> float:
    """Normals that lean off the surface bring no light of their own."""
    worst = 0.0
    for material in (WHITE, {"type": "roughconductor", "reflectance": 1.0, "alpha": 0.3}, {"type": "conductor"}):
        scene = {"camera": facing(2.2), "shapes": {"it": round_mesh(int(rings), material=material)}, "lights": SKY}
        worst = max(worst, float(harness.render(scene, spp=256, max_depth=-1).mean()) - 1.0)
    return max(worst, 0.0)


def touching(harness: Harness, size: float) -> float:
    """White boxes side by side on a white floor, under white light: a ray that is lost where they touch darkens them."""
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
    scene = {"camera": camera, "shapes": {**boxes, "floor": floor}, "lights": SKY}
    return relative(harness.render(scene, spp=256, max_depth=-1), 1.0)


def mirrored(harness: Harness, scale: float) -> float:
    """The front of what is mirrored stays its front."""
    pictures = []
    for z in (scale, -scale):
        shape = round_mesh(8, emission=1.0, transform=[{"scale": [1, 1, z]}])
        cube = {"type": "cube", "emission": 0.5, "transform": [{"scale": [0.3, 0.3, z]}, {"translate": [2, 0, 0]}]}
        pictures.append(
            harness.render({"camera": facing(6.0), "shapes": {"it": shape, "cube": cube}}, max_depth=1, size=16)
        )
    return relative_difference(*pictures)


def checks(harness: Harness, scale: float) -> float:
    """Squares of black and white however small: their mean, and black where the first is larger than the ball."""
    board = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "scale": [scale, scale]}
    found = float(harness.render(furnace({"type": "diffuse", "reflectance": board}), spp=256, max_depth=2).mean())
    if scale > 1e6:  # one square and the next have the same float32 coordinates
        return max(found - 1.0, -found, 0.0)
    return abs(found) if scale < 1e-3 else max(found - 0.75, 0.25 - found, 0.0)


def no_room_for_uv(harness: Harness, span: float) -> float:
    """An anisotropic metal on a mesh whose texture coordinates span this: where they give no frame the normal does."""
    mesh = round_mesh(6, material={"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.4, "reflectance": 1.0})
    mesh["uvs"] = (np.asarray(mesh["vertices"])[:, :2] * span).tolist()
    found = harness.render({"camera": facing(1.0), "shapes": {"it": mesh}, "lights": SKY}, max_depth=2)
    return max(float(found.mean()) - 1.0, 0.0) if float(found.mean()) > 0.5 else 1.0


CASES = (
    Case("smooth normals gain nothing", "radiance above 1", 2e-3, shaded_round, "rings", (2.0, 3.0, 4.0, 8.0, 32.0)),
    Case("boxes that touch", "relative to 1", 2e-3, touching, "size", powers(-6, 6, 3)),
    Case("mirrored shapes", "mean difference", 2e-3, mirrored, "scale", (1e-4, 1e-2, 1.0)),
    Case("textures of any fineness", "beyond its colours", 1e-6, checks, "squares", (*powers(-30, 0, 10), 1e3, 1e6, 1e9, 1e30)),
    Case("texture coordinates of any span", "radiance above 1", 2e-3, no_room_for_uv, "span", (0.0, *powers(-30, 30, 10))),
)  # fmt: skip
