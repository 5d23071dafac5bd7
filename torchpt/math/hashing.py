"""Integer hashing of int32 lanes (wrap-around arithmetic), with the same bits on every device and in every kernel.

Samplers make their random numbers of it. Torch has no unsigned 32-bit arithmetic, so bits are held in int32, as two's
complement.

``mix`` is Wellons' two-round multiply-xorshift of low bias ("Prospecting for hash functions", 2018): a bijection of 32 bits.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.core.dispatch import dispatched

__all__ = ["HALVES", "as_int32", "logical_shift", "mix", "mix_int", "reverse_bits", "to_unit"]

#: Pairs of a shift and a mask, from 1 to 16: groups of ``shift`` bits, of which every second one, the lower of two, is in the
#: mask. Swapping the groups of each pair, for all shifts, reverses 32 bits.
HALVES = ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF), (16, 0x0000FFFF))
#: Multipliers of ``mix``; the second as a signed 32-bit value.
_MULTIPLIER_0, _MULTIPLIER_1 = 0x7FEB352D, 0x846CA68B - (1 << 32)


def as_int32(x: int) -> int:
    """Return the low 32 bits of a Python integer as a signed value, which an int32 tensor accepts."""
    return ((x + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)


def logical_shift(x: Tensor, bits: int) -> Tensor:
    """Shift int32 lanes to the right and fill with zeros; torch's own shift is arithmetic."""
    return (x >> bits) & ((1 << (32 - bits)) - 1)


@dispatched
def reverse_bits(x: Tensor) -> Tensor:
    """Reverse the 32 bits of int32 lanes, or of int64 lanes whose high 32 bits are 0."""
    for shift, mask in HALVES:
        x = ((x >> shift) & mask) | ((x & mask) << shift)
    return x


def mix(x: Tensor) -> Tensor:
    """Hash int32 lanes ``(N,)``."""
    x = (x ^ logical_shift(x, 16)) * _MULTIPLIER_0
    x = (x ^ logical_shift(x, 15)) * _MULTIPLIER_1
    return x ^ logical_shift(x, 16)


def mix_int(x: int) -> int:
    """Hash a Python integer as :func:`mix` does; the result is a signed 32-bit value."""
    x &= 0xFFFFFFFF
    x = ((x ^ (x >> 16)) * 0x7FEB352D) & 0xFFFFFFFF
    x = ((x ^ (x >> 15)) * 0x846CA68B) & 0xFFFFFFFF
    return as_int32(x ^ (x >> 16))


def to_unit(x: Tensor) -> Tensor:
    """Convert the top 24 bits of int32 lanes to float32 in ``[0, 1 - 2^-24]``, exactly."""
    return logical_shift(x, 8).to(torch.float32) * (1.0 / (1 << 24))
