"""Intervals of equal length, one point in each: what the samplers that know their number of points share."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.samplers.scrambling import X
from torchpt.samplers.shuffling import shuffle

__all__ = ["jittered", "place"]

_LEVELS = float(1 << 24)


def place(stratum: Tensor, jitter: Tensor, count: Tensor) -> Tensor:
    """``(stratum + jitter) / count`` as float32 below one, for float64 lanes; cut to 24 bits as all of our numbers are."""
    return ((stratum + jitter) / count * _LEVELS).floor().clamp_max(_LEVELS - 1.0).to(torch.float32) * (1.0 / _LEVELS)


def jittered(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(N,)`` float32 in ``[0, 1)``, one in each of as many intervals as there are points, in an order by ``salt``.

    ``key (3, N)`` int32: the pixel's seed, the point's index, and how many there are.
    """
    seed = mix(key[0] ^ salt)
    stratum = shuffle(key[1], key[2], seed)
    return place(stratum.double(), to_unit(mix(mix(seed ^ X) ^ stratum)).double(), key[2].double())
