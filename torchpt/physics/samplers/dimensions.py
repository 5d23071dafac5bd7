"""The dimensions of random numbers along a path, and their hashes."""

from __future__ import annotations

from enum import IntEnum

from torchpt.math.hashing import mix_int

__all__ = ["STREAMS", "Dimension", "salt"]


class Dimension(IntEnum):
    """The use of a random number. ``PIXEL`` and ``LENS`` are drawn once a path, the others at every vertex."""

    PIXEL = 0  # 2D, offset in the reconstruction filter
    LENS = 1  # 2D, point on the lens
    LIGHT_DIGITS = 2  # 1D, low digits of the first number of LIGHT
    LIGHT = 3  # 2D, choice of the light, and point on it
    LOBE = 4  # 1D, choice of the lobe
    BSDF = 5  # 2D, direction
    ROULETTE = 6  # 1D
    OPACITY = 7  # 1D, hit or pass through
    PREVIOUS_DIRECTION = 8  # an alias of the dimension that led to the vertex: BSDF of the previous vertex, or PIXEL
    DISTANCE = 9  # 1D, free-flight distance in a medium
    PHASE = 10  # 2D, direction from a phase function
    EDGE = 11  # 2D, choice of an edge of the scene and point on it; choice of its line if it has two


#: Stride between vertices, larger than the number of dimensions, so that a new dimension does not change the others.
STREAMS = 16


#: Stride between steps on the way to a vertex, in vertices: numbers repeat only on paths with more vertices.
STEPS = 1 << 13


def salt(dimension: Dimension, depth: int, step: int = 0) -> int:
    """Return the hash of a dimension at a path vertex, a signed 32-bit integer.

    Args:
        dimension: the use of the number.
        depth: depth of the path vertex; 0 is the camera.
        step: index of the surface that the ray passes on its way to the vertex.
    """
    if dimension is Dimension.PREVIOUS_DIRECTION:
        dimension, depth = (Dimension.BSDF, depth - 1) if depth > 1 else (Dimension.PIXEL, 0)
    return mix_int(0x9E3779B9 * (1 + (depth + step * STEPS) * STREAMS + int(dimension)))
