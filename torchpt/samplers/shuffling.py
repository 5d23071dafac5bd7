"""Permutations of any length by hashing, a lane at a time and without a branch.

The swap-or-not shuffle (Hoang, Morris, Rogaway, *An Enciphering Scheme Based on a Card Shuffle*, CRYPTO 2012): a round
pairs ``x`` with ``pivot - x`` modulo the length and swaps the pair or not, by a hash of its larger member. It is a bijection
whatever the length, so nothing is drawn again as in a walk along the cycles of a larger permutation. A rotation comes first:
it makes the place of any one index uniform, so that padded dimensions are free of bias whatever the rounds; these part
neighbours, of whose order ``2^-r`` is left after ``r``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, logical_shift, mix

__all__ = ["ROUNDS", "STEP", "STRIDE", "shuffle"]

ROUNDS = 8
#: A linear congruential generator gives the pivots, whose top bits alone are used (constants of O'Neill's PCG, 2014).
STRIDE, STEP = 0x2C9277B5, as_int32(0xAC564B05)


def shuffle(index: Tensor, count: Tensor, seed: Tensor) -> Tensor:
    """The place of ``index`` under a permutation of ``0 .. count - 1`` that ``seed`` names; int32 lanes ``(N,)``."""
    wide = count.to(torch.int64)

    def pivot(seed: Tensor) -> Tensor:
        return ((logical_shift(seed, 1).to(torch.int64) * wide) >> 31).to(torch.int32)

    def wrapped(x: Tensor) -> Tensor:
        return x + ((x >> 31) & count)

    index = wrapped(index - pivot(seed))
    for _ in range(ROUNDS):
        seed = seed * STRIDE + STEP
        partner = wrapped(pivot(seed) - index)
        swap = mix(torch.maximum(index, partner) ^ seed) >> 31  # all bits or none
        index = index ^ ((index ^ partner) & swap)
    return index
