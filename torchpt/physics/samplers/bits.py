"""Integer arithmetic of samplers: Sobol' points, Owen scrambling, permutations, strata.

Kinds of samplers compose these functions. All take int32 lanes ``(N,)`` unless said: 32-bit words are signed here, as in torch,
and products and sums wrap around.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import HALVES, as_int32, logical_shift, mix, reverse_bits, to_unit

__all__ = [
    "ROUNDS",
    "SEED_W",
    "SEED_X",
    "SEED_Y",
    "SEED_Z",
    "fourth_dimension",
    "jittered",
    "point_in_stratum",
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


#: Arbitrary constants that are mixed into a seed, so that each of up to four coordinates is scrambled by itself.
SEED_X, SEED_Y, SEED_Z, SEED_W = as_int32(0x68BC21EB), as_int32(0x02E5BE93), as_int32(0x967A889B), as_int32(0x368CC8B7)
#: Multipliers of Vegdahl's scrambling hash.
_HASH_0, _HASH_1, _HASH_2 = 0x3D20ADEA, 0x05526C56, 0x53A22864
#: Low bits of the base-4 digits whose position, from the lowest, is 0, 1 or 2 modulo 3: powers of w repeat after three.
_DIGITS_0, _DIGITS_1, _DIGITS_2 = 0x41041041, 0x04104104, 0x10410410
#: Both bits of the digits at positions 0 modulo 3, whose factor is 1.
_UNCHANGED = as_int32(3 * _DIGITS_0)
#: Low bits of all base-4 digits.
_LOW_BITS = 0x55555555


def scramble(x: Tensor, seed: Tensor) -> Tensor:
    """Apply Owen scrambling to bit-reversed numbers ``x``: each bit is flipped by a hash of ``seed`` and the bits below it."""
    x = x ^ (x * _HASH_0)
    x = x + seed
    x = x * (logical_shift(seed, 16) | 1)
    x = x ^ (x * _HASH_1)
    return x ^ (x * _HASH_2)


def second_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed second Sobol' coordinate of point ``index``: the coefficients of ``p(x + 1)``."""
    for shift, mask in reversed(
        HALVES
    ):  # shifts 16 to 1, each with the mask of the lower one of each two groups of bits
        index = index ^ ((index >> shift) & mask)
    return index


def third_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed third coordinate of point ``index``: ``p(x + w)``, as ``q(y) = p(w y)`` at ``y = w² x + 1``."""
    return _times_powers(_shifted(_times_powers(index, w=_DIGITS_1, w2=_DIGITS_2)), w=_DIGITS_2, w2=_DIGITS_1)


def fourth_dimension(index: Tensor) -> Tensor:
    """Return the bit-reversed fourth coordinate of point ``index``: ``p(x + w²)``, one bit of each digit added to the other."""
    index = _times_powers(_shifted(_times_powers(index, w=_DIGITS_2, w2=_DIGITS_1)), w=_DIGITS_1, w2=_DIGITS_2)
    return index ^ ((index >> 1) & _LOW_BITS)


def _shifted(index: Tensor) -> Tensor:
    """Return the coefficients of ``p(x + 1)`` for a ``p`` whose coefficients, in ``index``, have two bits each."""
    for shift, mask in reversed(HALVES[1:]):  # without the shift by 1, which would mix the two bits of a coefficient
        index = index ^ ((index >> shift) & mask)
    return index


def _times_powers(index: Tensor, *, w: int, w2: int) -> Tensor:
    """Multiply the base-4 digits whose low bits are in the mask ``w`` by w, and those in ``w2`` by w².

    By w a digit's bits (low, high) become (high, low + high), modulo 2; by w² they become (low + high, low).
    """
    low, high = index & _LOW_BITS, (index >> 1) & _LOW_BITS
    both = low ^ high
    return (index & _UNCHANGED) | (high & w) | (both & w2) | (((both & w) | (low & w2)) << 1)


# ---- Permutations of any length by hashing, for each lane separately and without branches
#
# The swap-or-not shuffle (Hoang, Morris, Rogaway, *An Enciphering Scheme Based on a Card Shuffle*, CRYPTO 2012): a round
# pairs ``x`` with ``pivot - x`` modulo the length and swaps the pair or not, by a hash of its larger member. It is a bijection
# for any length, without the rejections of a cycle walk. A rotation comes first: it makes the position of each single index
# uniform, so that padded dimensions are unbiased for any number of rounds. Each round separates half of the neighbours that are
# still in order.


#: Rounds of the shuffle: some ``2^-ROUNDS`` of the original order remains.
ROUNDS = 8
#: A linear congruential generator gives the pivots, whose top bits alone are used (constants of O'Neill's PCG, 2014).
_MULTIPLIER, _INCREMENT = 0x2C9277B5, as_int32(0xAC564B05)


def shuffle(index: Tensor, count: Tensor, seed: Tensor) -> Tensor:
    """Return the image of ``index`` under the permutation of ``0 .. count - 1`` given by ``seed``; all int32 ``(N,)``."""
    wide = count.to(torch.int64)

    def pivot(seed: Tensor) -> Tensor:  # uniform in 0 .. count - 1: the top 31 bits as a fraction of count
        return ((logical_shift(seed, 1).to(torch.int64) * wide) >> 31).to(torch.int32)

    def wrapped(x: Tensor) -> Tensor:  # x modulo count, for -count <= x < count: x >> 31 is -1 where x is negative
        return x + ((x >> 31) & count)

    index = wrapped(index - pivot(seed))
    for _ in range(ROUNDS):
        seed = seed * _MULTIPLIER + _INCREMENT
        partner = wrapped(pivot(seed) - index)
        swap = mix(torch.maximum(index, partner) ^ seed) >> 31  # all bits or none
        index = index ^ ((index ^ partner) & swap)
    return index


# ---- Stratification into equal intervals, for samplers with a known number of points


#: Numbers are multiples of one over this, as float32 holds 24 bits.
_LEVELS = float(1 << 24)


def point_in_stratum(stratum: Tensor, jitter: Tensor, count: Tensor) -> Tensor:
    """Return ``(stratum + jitter) / count`` as float32 below 1, truncated to 24 bits as all numbers are.

    Args:
        stratum: index of the interval, or its position in intervals, from 0 below ``count``; float64 ``(N,)``, as all three.
        jitter: position within the interval, from 0 below 1.
        count: number of intervals.
    """
    return ((stratum + jitter) / count * _LEVELS).floor().clamp_max(_LEVELS - 1.0).to(torch.float32) * (1.0 / _LEVELS)


def jittered(key: Tensor, salt: Tensor | int) -> Tensor:
    """Return jittered numbers ``(N,)`` float32, one in each of ``count`` intervals of ``[0, 1)``, in an order by ``salt``.

    Args:
        key: ``(3, N)`` int32: seed of the pixel, index of the point, number ``count`` of points.
        salt: int32, the hash of the dimension.
    """
    pixel_seed, point, count = key[0], key[1], key[2]
    seed = mix(pixel_seed ^ salt)
    stratum = shuffle(point, count, seed)
    return point_in_stratum(stratum.double(), to_unit(mix(mix(seed ^ SEED_X) ^ stratum)).double(), count.double())
