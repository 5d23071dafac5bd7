"""The dimensions of a path, named once. A random number is a pure function of (seed, pixel, sample, dimension)."""

from __future__ import annotations

from enum import IntEnum

from torchpt.math.hashing import mix_int

__all__ = ["STREAMS", "Dimension", "salt"]


class Dimension(IntEnum):
    """The use of a random number. ``PIXEL`` and ``LENS`` are drawn once a path, the others at every vertex."""

    PIXEL = 0  # 2D, place within the pixel's filter
    LENS = 1  # 2D, place on the aperture
    LIGHT_DIGITS = 2  # 1D, further digits of the first number of LIGHT
    LIGHT = 3  # 2D, which light, and the place on it
    LOBE = 4  # 1D, which part of the BSDF
    BSDF = 5  # 2D, direction
    ROULETTE = 6  # 1D
    OPACITY = 7  # 1D, whether a surface is met
    PREVIOUS_DIRECTION = 8  # no number of its own: by which the vertex was reached, BSDF of the one before or PIXEL
    DISTANCE = 9  # 1D, how far a ray comes in what lies between surfaces
    PHASE = 10  # 2D, where that scatters it to
    EDGE = 11  # 2D, which edge of the scene and the place on it; which of its two lines where it has two


#: More than there are dimensions, so that a new one leaves the numbers of the others as they were.
STREAMS = 16


#: Vertices between the numbers of one step on the way to a vertex and those of the next: only the numbers of paths that are
#: longer meet those of steps.
STEPS = 1 << 13


def salt(dimension: Dimension, depth: int, step: int = 0) -> int:
    """Return a signed 32-bit constant that names a random number.

    Args:
        dimension: its use.
        depth: of the path vertex; 0 is the camera.
        step: of the ray on its way to the vertex, through what lets rays pass.
    """
    if dimension is Dimension.PREVIOUS_DIRECTION:
        dimension, depth = (Dimension.BSDF, depth - 1) if depth > 1 else (Dimension.PIXEL, 0)
    return mix_int(0x9E3779B9 * (1 + (depth + step * STEPS) * STREAMS + int(dimension)))
