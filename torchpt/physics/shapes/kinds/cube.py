"""Cubes of triangles, with four vertices a side for flat normals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from torchpt.physics.shapes.base import Shape, Triangles

__all__ = ["Cube"]

# outward normal, then the directions of +u and of +v on that side; sides in Mitsuba's order
_SIDES = (
    ((0, -1, 0), (0, 0, 1), (1, 0, 0)),
    ((0, 1, 0), (-1, 0, 0), (0, 0, -1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, -1, 0), (1, 0, 0)),
)
_UVS = ((0, 1), (1, 1), (1, 0), (0, 0))  # of the four vertices of a side


class Cube(Shape):
    """The cube ``[-1, 1]^3`` with outward face normals, then transformed."""

    name = "cube"
    meshed = True  # made of triangles, which instances may share

    @classmethod
    def triangles(cls, values: Mapping[str, Any]) -> Triangles:
        """Return 24 vertices and 12 triangles, with outward normals and the uv of Mitsuba's ``cube``."""
        vertices, normals, faces = [], [], []
        for side, frame in enumerate(_SIDES):
            normal, along_u, along_v = np.array(frame, dtype=np.float64)
            vertices += [normal + (2 * u - 1) * along_u + (2 * v - 1) * along_v for u, v in _UVS]
            normals += [normal] * 4
            faces += [[4 * side, 4 * side + 1, 4 * side + 2], [4 * side + 3, 4 * side, 4 * side + 2]]
        uvs = np.tile(np.array(_UVS, dtype=np.float64), (6, 1))
        return Triangles(
            vertices=np.array(vertices),
            faces=np.array(faces, dtype=np.int64),
            normals=np.array(normals),
            uvs=uvs,
            flat=True,
        )
