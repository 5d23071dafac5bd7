"""Independent uniform numbers by counter-based hashing: no state, no order."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, to_unit

__all__ = ["NEEDS_COUNT", "draw_1d", "draw_2d"]

#: Any number of points may be drawn, and then more.
NEEDS_COUNT = False
_SECOND = as_int32(0x9E3779B9)


def _word(key: Tensor, salt: Tensor | int) -> Tensor:
    # Two rounds: the first spreads the sample index under this dimension's salt, the second brings in the pixel, so
    # that two lanes share a number only if both rounds collide, and then in this one dimension alone.
    return mix(mix(key[1] ^ salt) + key[0])


def draw_1d(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(N,)`` float32 in ``[0, 1)``. ``key (2, N)`` int32 holds the pixel's seed and the sample's index."""
    return to_unit(_word(key, salt))


def draw_2d(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(2, N)`` float32 in ``[0, 1)``."""
    word = _word(key, salt)
    return torch.stack((to_unit(word), to_unit(mix(word ^ _SECOND))))
