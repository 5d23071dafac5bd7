"""Jittered strata: as many as a pixel has points, each with one point in it, in an order of its own for each dimension.

In two dimensions the strata stand in ``round(sqrt(count))`` columns that hold as equal a number of strata as can be and are
as wide as that: all have the same area and are nearly square, whatever the count (a prime one included).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, to_unit
from torchpt.samplers.shuffling import shuffle

__all__ = ["NEEDS_COUNT", "draw_1d", "draw_2d", "place"]

#: The number of points must be known before the first is drawn.
NEEDS_COUNT = True
_X, _Y = as_int32(0x68BC21EB), as_int32(0x02E5BE93)
_LEVELS = float(1 << 24)


def place(stratum: Tensor, jitter: Tensor, count: Tensor) -> Tensor:
    """``(stratum + jitter) / count`` as float32 below one, for float64 lanes; cut to 24 bits as all of our numbers are."""
    return ((stratum + jitter) / count * _LEVELS).floor().clamp_max(_LEVELS - 1.0).to(torch.float32) * (1.0 / _LEVELS)


def draw_1d(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(N,)`` float32 in ``[0, 1)``. ``key (3, N)`` int32: the pixel's seed, the point's index, and how many there are."""
    seed = mix(key[0] ^ salt)
    stratum = shuffle(key[1], key[2], seed)
    return place(stratum.double(), to_unit(mix(mix(seed ^ _X) ^ stratum)).double(), key[2].double())


def draw_2d(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(2, N)`` float32 in ``[0, 1)``."""
    seed = mix(key[0] ^ salt)
    stratum = shuffle(key[1], key[2], seed)
    jitter = to_unit(mix(mix(seed ^ _X) ^ stratum)).double(), to_unit(mix(mix(seed ^ _Y) ^ stratum)).double()
    # Whole numbers below 2^53, so that quotients are floored rightly.
    k, count = stratum.double(), key[2].double()
    columns = (count.sqrt() + 0.5).floor()
    column = (((k + 1.0) * columns - 1.0) / count).floor()
    first, end = (column * count / columns).floor(), ((column + 1.0) * count / columns).floor()
    rows = end - first
    return torch.stack((place(first, jitter[0] * rows, count), place(k - first, jitter[1], rows)))
