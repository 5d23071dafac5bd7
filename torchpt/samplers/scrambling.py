"""Owen scrambling and Sobol' points on bit-reversed int32 lanes.

Burley, *Practical Hash-based Owen Scrambling*, JCGT 10(4), 2020. The scrambling hash is Vegdahl's refinement
("Owen scrambling based permutation hash", 2021) of the Laine-Karras permutation.

Working with bit-reversed numbers throughout spares most reversals. The first coordinate of point ``i`` is the reversal of
``i``; the second is the reversal of ``p(x + 1)`` where ``p`` is the polynomial over GF(2) whose coefficients are the bits
of ``i`` (its direction numbers are the powers of ``x + 1``), and that shift takes five masked xor-shifts.
"""

from __future__ import annotations

from torch import Tensor

from torchpt.math.hashing import as_int32, logical_shift

__all__ = ["X", "Y", "reverse_bits", "scramble", "second_dimension"]

#: What a seed is mixed with for the first and for the second coordinate.
X, Y = as_int32(0x68BC21EB), as_int32(0x02E5BE93)
_K0, _K1, _K2 = 0x3D20ADEA, 0x05526C56, 0x53A22864
_HALVES = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))


def reverse_bits(x: Tensor) -> Tensor:
    """Reverse the 32 bits of int32 lanes."""
    for shift, mask in _HALVES:
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return x


def scramble(x: Tensor, seed: Tensor) -> Tensor:
    """Nested uniform scramble of bit-reversed numbers: each bit is flipped by a hash of the bits below it."""
    x = x ^ (x * _K0)
    x = x + seed
    x = x * (logical_shift(seed, 16) | 1)
    x = x ^ (x * _K1)
    return x ^ (x * _K2)


def second_dimension(index: Tensor) -> Tensor:
    """Bit-reversed second Sobol' coordinate of point ``index``."""
    for shift, mask in reversed(_HALVES):
        index = index ^ ((index >> shift) & mask)
    return index
