"""A ball of twenty faces that are shaded smooth: near its outline the shading normal turns away from the viewer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

__all__ = ["CORNERS", "ball_under"]

_GOLDEN = (1.0 + math.sqrt(5.0)) / 2.0
_LENGTH = math.hypot(1.0, _GOLDEN)
#: Corners of the icosahedron, on the unit sphere.
CORNERS = [
    [x / _LENGTH for x in corner]
    for a in (-1.0, 1.0)
    for b in (-_GOLDEN, _GOLDEN)
    for corner in ((0.0, a, b), (a, b, 0.0), (b, 0.0, a))
]


def _faces() -> list[list[int]]:
    """Return the triples of corners that are next to one another, counter-clockwise from outside."""
    near = 2.0 / _LENGTH + 1e-6

    def close(i: int, j: int) -> bool:
        return math.dist(CORNERS[i], CORNERS[j]) < near

    def front(i: int, j: int, k: int) -> bool:
        a, b, c = CORNERS[i], CORNERS[j], CORNERS[k]
        u, v = [q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)]
        n = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
        return sum(p * q for p, q in zip(n, a, strict=True)) > 0

    some = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if close(i, j) and close(j, k) and close(i, k)
    ]
    return [[i, j, k] if front(i, j, k) else [i, k, j] for i, j, k in some]


def ball_under(lights: Mapping[str, Any], material: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return a scene of the ball alone; ``more``: replaces its blocks, and adds to ``shapes`` and ``materials``."""
    ball = {"type": "mesh", "vertices": CORNERS, "faces": _faces(), "normals": CORNERS, "material": "it"}
    return {
        "camera": {"type": "perspective", "origin": [0.3, -4, 1.2], "target": [0, 0, 0], "up": [0, 0, 1], "fov": 40},
        "film": {"width": 24, "height": 24, "filter": "box"},
        "integrator": {"type": "path", "max_depth": 2},
        **more,
        "lights": dict(lights),
        "materials": {"it": dict(material), **more.get("materials", {})},
        "shapes": {"ball": ball, **more.get("shapes", {})},
    }
