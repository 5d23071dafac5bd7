"""One Sobol' sequence for the whole film, distributed along a Z-order curve, for blue-noise error.

Ahmed and Wonka, *Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error via Hierarchical Ordering of Pixels*, ACM
TOG 39(6), 2020; as in pbrt-4's ``ZSobolSampler``. Each square of 2x2, 4x4, ... pixels has a contiguous part of the sequence,
so errors in it cancel. The base-4 digits of a position on the curve are permuted by a hash of the digits above them,
differently for each dimension.

Every permutation of four digits is an affine map of two bits, ``A d + b`` with an invertible ``A``: there are 6 * 4 = 24.

The position of a sample on the curve is the Morton code of its pixel, followed by the bits of its index within the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import logical_shift, mix, to_unit
from torchpt.physics.samplers.base import Points, SamplerTensors
from torchpt.physics.samplers.bits import SEED_X, SEED_Y, reverse_bits, scramble, second_dimension

__all__ = ["ZSobol"]

#: Number of permuted base-4 digits. Positions that share all digits above are a block of 2^24 samples with its own sequence.
DIGITS = 12


def _spread(x: Tensor) -> Tensor:
    """Return the low 16 bits of int64 lanes with a zero bit before each: half of a Morton code."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        x = (x | (x << shift)) & mask
    return x


def _index(word: Tensor, state: Tensor) -> Tensor:
    """Return the index in the Sobol' sequence for a position on the curve.

    Args:
        word: the position, as the second row of :meth:`ZSobol.key` has it ``(N,)`` int32.
        state: hash of the block and the dimension ``(N,)`` int32; digit by digit it becomes the hash of the digits above too.
    """
    index = torch.zeros_like(word)
    for shift in range(2 * DIGITS - 1, 0, -2):
        digit = (word >> shift) & 3
        # Columns of A, as integers 1 to 3: one of three vectors, then one of the other two (bit 4 of the hash chooses). The
        # bits 2 and 3 of the hash are b.
        one = 1 + ((logical_shift(state, 16) * 3) >> 16)
        other = 1 + one - 3 * ((one + 1) >> 2)
        other = other ^ (one & -((state >> 4) & 1))
        permuted = (one & -(digit & 1)) ^ (other & -(digit >> 1)) ^ ((state >> 2) & 3)
        index = index | (permuted << shift)
        state = mix(state + digit + 1)
    # With an odd number of bits the last binary digit is flipped or not; else it is dropped.
    odd = logical_shift(word, 31)
    return (index | (((word ^ state) & 1) & odd)) >> (1 - odd)


@dataclass(frozen=True)
class ZSobol(Points):
    """One Sobol' sequence for the film along a Z-order curve: with few samples a pixel the error is blue noise."""

    name = "zsobol"
    needs_count = True  # the number of points must be known beforehand
    of_film = True  # points depend on the position of a pixel on the film

    def key(self, tensors: SamplerTensors, pixel: Tensor, randomization: Tensor, point: Tensor) -> Tensor:
        """Return ``(2, N)`` int32: the seed of the block, and the position of the point on the curve within it.

        The position has ``DIGITS`` digits of two bits above a single bit. If ``tensors.index_bits`` is odd, the single bit is
        the last of the point's index and the sign bit is set; else it is unused. Arguments as for :meth:`Points.key`.
        """
        seed = torch.index_select(tensors.seeds, 0, randomization)
        bits, width = tensors.index_bits, tensors.film_width
        odd = bits & 1
        code = _spread(pixel % width) | (_spread(pixel // width) << 1)
        curve = (code << bits) | point  # position on the curve of the whole film, int64
        size = odd + 2 * DIGITS  # bits of a position within a block
        within = (curve & ((torch.ones_like(size) << size) - 1)) << (1 - odd)
        # The block's index has up to 64 bits: its low half is hashed, the rest is added above bit 16.
        block = mix(mix((curve >> size).to(torch.int32)) + ((curve >> (size + 32)).to(torch.int32) << 16))
        return torch.stack((mix(block ^ seed), (within | -(odd << 31)).to(torch.int32)))

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return the first coordinate of the sample's Sobol' point; arguments as for :meth:`Points.draw_1d`."""
        seed = mix(key[0] ^ salt)
        return to_unit(reverse_bits(scramble(_index(key[1], seed), mix(seed ^ SEED_X))))

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return the sample's Sobol' point; arguments as for :meth:`Points.draw_1d`."""
        seed = mix(key[0] ^ salt)
        index = _index(key[1], seed)
        x = scramble(index, mix(seed ^ SEED_X))
        y = scramble(second_dimension(index), mix(seed ^ SEED_Y))
        return torch.stack((to_unit(reverse_bits(x)), to_unit(reverse_bits(y))))
