"""The dimensions of random numbers along a path, and their hashes, the *salts*.

Each number of a path has a dimension: its use, the vertex that it is drawn at, and the step on the way there (a ray that passes
surfaces by their opacity draws a number at each). The salt makes the numbers of two dimensions independent.
"""

from __future__ import annotations

from enum import IntEnum

from torchpt.math.hashing import mix_int

__all__ = ["DIMENSIONS_OF_VERTEX", "Dimension", "salt"]


class Dimension(IntEnum):
    """The use of a random number. ``PIXEL`` and ``LENS`` are drawn once a path, the others at every vertex."""

    PIXEL = 0  # 2D, offset in the reconstruction filter
    LENS = 1  # 2D, point on the lens
    LIGHT_DIGITS = 2  # 1D, low digits of the first number of LIGHT, whose high digits the choice of the light uses up
    LIGHT = 3  # 2D, choice of the light, and point on it
    LOBE = 4  # 1D, choice of the lobe
    BSDF = 5  # 2D, direction from a BSDF
    ROULETTE = 6  # 1D, whether the path survives Russian roulette
    OPACITY = 7  # 1D, hit or pass through
    #: An alias of the dimension that led to the vertex: BSDF of the previous vertex, or PIXEL. With it, samplers that have sets
    #: of four numbers draw the last two of that set for the point on a light: so direction and light are stratified together.
    PREVIOUS_DIRECTION = 8
    DISTANCE = 9  # 1D, free-flight distance in a medium
    PHASE = 10  # 2D, direction from a phase function
    #: 2D: the first number chooses an edge of the scene and the point on it, the second one of the two silhouette lines of a
    #: cone or cylinder.
    EDGE = 11
    MERGE = 12  # 1D, choice among the photons near a vertex; a hash, not of the sampler's points


#: Stride between the dimensions of two vertices: more than there are, so that a new dimension does not change the others.
DIMENSIONS_OF_VERTEX = 16
#: Stride between two steps on the way to a vertex, in vertices: numbers repeat only on paths with more vertices than this.
VERTICES_OF_STEP = 1 << 13
#: Odd multiplier that spreads consecutive indices over 32 bits before they are hashed: 2^32 over the golden ratio (Knuth).
_GOLDEN = 0x9E3779B9


def salt(dimension: Dimension, depth: int, step: int = 0) -> int:
    """Return the hash of a dimension at a path vertex, a signed 32-bit integer.

    Args:
        dimension: the use of the number.
        depth: depth of the path vertex; 0 is the camera.
        step: number of surfaces that the ray has passed on its way to the vertex.
    """
    if dimension is Dimension.PREVIOUS_DIRECTION:
        # The first surface vertex (depth 1) was reached from the camera, whose direction is drawn by PIXEL.
        dimension, depth = (Dimension.BSDF, depth - 1) if depth > 1 else (Dimension.PIXEL, 0)
    return mix_int(_GOLDEN * (1 + (depth + step * VERTICES_OF_STEP) * DIMENSIONS_OF_VERTEX + int(dimension)))
