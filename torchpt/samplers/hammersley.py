"""Hammersley points ``(i / n, van der Corput(i))``, padded: each set of dimensions is shuffled and scrambled for itself.

The second coordinate is Owen-scrambled rather than rotated (Cranley-Patterson): a rotation moves points across the
elementary intervals that hold one each, and leaves the same grid in every pixel; scrambling keeps every interval and lets the
variance of smooth integrands fall faster than ``n^-2``. For the same end the first is jittered within its ``n``-th. The order
is a permutation of any length, so that sets of dimensions are independent and ``n`` need not be a power of two.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, to_unit
from torchpt.samplers.shuffling import shuffle
from torchpt.samplers.sobol import reverse_bits, scramble
from torchpt.samplers.stratified import draw_1d, place

__all__ = ["NEEDS_COUNT", "draw_1d", "draw_2d"]

#: The number of points must be known before the first is drawn.
NEEDS_COUNT = True
_X, _Y = as_int32(0x68BC21EB), as_int32(0x02E5BE93)


def draw_2d(key: Tensor, salt: Tensor | int) -> Tensor:
    """``(2, N)`` float32 in ``[0, 1)``; ``key (3, N)`` as in :func:`stratified.draw_1d`."""
    seed = mix(key[0] ^ salt)
    index = shuffle(key[1], key[2], seed)
    x = place(index.double(), to_unit(mix(mix(seed ^ _X) ^ index)).double(), key[2].double())
    return torch.stack((x, to_unit(reverse_bits(scramble(index, mix(seed ^ _Y))))))
