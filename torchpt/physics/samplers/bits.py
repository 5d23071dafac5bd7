"""Integer arithmetic of samplers: Sobol' points, Owen scrambling, permutations, strata."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import HALVES, as_int32, logical_shift, mix, reverse_bits, to_unit

__all__ = [
    "ROUNDS",
    "STEP",
    "STRIDE",
    "W",
    "X",
    "Y",
    "Z",
    "fourth_dimension",
    "jittered",
    "place",
    "reverse_bits",
    "scramble",
    "second_dimension",
    "shuffle",
    "third_dimension",
]


# ---- Owen scrambling and Sobol' points on bit-reversed int32 lanes
#
# Burley, *Practical Hash-based Owen Scrambling*, JCGT 10(4), 2020. The scrambling hash is Vegdahl's refinement
# ("Owen scrambling based permutation hash", 2021) of the Laine-Karras permutation.
#
# Bit-reversed numbers throughout avoid most reversals. The first coordinate of point ``i`` is the reversal of
# ``i``; the second is the reversal of ``p(x + 1)`` where ``p`` is the polynomial over GF(2) whose coefficients are the bits
# of ``i`` (its direction numbers are the powers of ``x + 1``), and that shift takes five masked xor-shifts.
#
# The third and the fourth are of the same kind over the field of four elements 0, 1, w, w², whose digits are pairs of bits:
# reversals of ``p(x + w)`` and ``p(x + w²)`` (Niederreiter, *Point sets and sequences with small discrepancy*, 1987). All four
# are a (0, 4)-sequence in base 4: of any 4^m points each box of volume 4^-m whose sides are powers of 4 holds one. As in the SZ
# sequences of Ahmed, Skopenkov, Hadwiger and Wonka (2024) the two are a (0, 2)-sequence in base 2 by themselves, as the first
# two are; a bit of each digit of the fourth is added to the other for that.


#: Constants that are mixed into a seed, for each of four coordinates.
X, Y, Z, W = as_int32(0x68BC21EB), as_int32(0x02E5BE93), as_int32(0x967A889B), as_int32(0x368CC8B7)
_K0, _K1, _K2 = 0x3D20ADEA, 0x05526C56, 0x53A22864
#: Low bits of the base-4 digits whose position is 0, 1 or 2 modulo 3.
_FIRST, _SECOND, _THIRD = 0x41041041, 0x04104104, 0x10410410
_STAYS = as_int32(3 * _FIRST)


def scramble(x: Tensor, seed: Tensor) -> Tensor:
    """Apply Owen scrambling to bit-reversed numbers: each bit is flipped by a hash of the bits below it."""
    x = x ^ (x * _K0)
    x = x + seed
    x = x * (logical_shift(seed, 16) | 1)
    x = x ^ (x * _K1)
    return x ^ (x * _K2)


def second_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed second Sobol' coordinate of point ``index``."""
    for shift, mask in reversed(HALVES):
        index = index ^ ((index >> shift) & mask)
    return index


def third_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed third coordinate of point ``index``."""
    return _turned(_shifted(_turned(index, _SECOND, _THIRD)), _THIRD, _SECOND)


def fourth_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed fourth coordinate of point ``index``."""
    index = _turned(_shifted(_turned(index, _THIRD, _SECOND)), _SECOND, _THIRD)
    return index ^ ((index >> 1) & 0x55555555)


def _shifted(index: Tensor) -> Tensor:
    """Return ``p(x + 1)`` for coefficients of two bits each."""
    for shift, mask in reversed(HALVES[1:]):
        index = index ^ ((index >> shift) & mask)
    return index


def _turned(index: Tensor, once: int, twice: int) -> Tensor:
    """Multiply base-4 digits by w at positions ``once``, by w² at ``twice``; w maps bits (low, high) to (high, low + high)."""
    low, high = index & 0x55555555, (index >> 1) & 0x55555555
    both = low ^ high
    return (index & _STAYS) | (high & once) | (both & twice) | (((both & once) | (low & twice)) << 1)


# ---- Permutations of any length by hashing, for each lane separately and without branches
#
# The swap-or-not shuffle (Hoang, Morris, Rogaway, *An Enciphering Scheme Based on a Card Shuffle*, CRYPTO 2012): a round
# pairs ``x`` with ``pivot - x`` modulo the length and swaps the pair or not, by a hash of its larger member. It is a bijection
# for any length, without the rejections of a cycle walk. A rotation comes first: it makes the position of each single index
# uniform, so that padded dimensions are unbiased for any number of rounds. Each round separates half of the neighbours that are
# still in order.


ROUNDS = 8
#: A linear congruential generator gives the pivots, whose top bits alone are used (constants of O'Neill's PCG, 2014).
STRIDE, STEP = 0x2C9277B5, as_int32(0xAC564B05)


def shuffle(index: Tensor, count: Tensor, seed: Tensor) -> Tensor:
    """Return the image of ``index`` under the permutation of ``0 .. count - 1`` given by ``seed``; int32 ``(N,)``."""
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


# ---- Stratification into equal intervals, for samplers with a known number of points


_LEVELS = float(1 << 24)


def place(stratum: Tensor, jitter: Tensor, count: Tensor) -> Tensor:
    """Return ``(stratum + jitter) / count`` of float64 lanes as float32 below 1, truncated to 24 bits as all numbers are."""
    return ((stratum + jitter) / count * _LEVELS).floor().clamp_max(_LEVELS - 1.0).to(torch.float32) * (1.0 / _LEVELS)


def jittered(key: Tensor, salt: Tensor | int) -> Tensor:
    """Return jittered numbers ``(N,)`` float32, one in each of ``count`` intervals of ``[0, 1)``, in an order by ``salt``.

    ``key (3, N)`` int32: seed of the pixel, index of the point, number ``count`` of points.
    """
    seed = mix(key[0] ^ salt)
    stratum = shuffle(key[1], key[2], seed)
    return place(stratum.double(), to_unit(mix(mix(seed ^ X) ^ stratum)).double(), key[2].double())
