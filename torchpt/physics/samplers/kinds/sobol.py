"""Owen-scrambled digital sequences, padded: each set of dimensions is shuffled separately.

Sets of one or two dimensions are Sobol' points. The numbers of a light sample and those of the direction that led to its
vertex (or of the film position) are the two halves of a set of four dimensions, stratified together.

A key has two rows: seed of the pixel, index of the point. The functions of ``bits.py`` take and return bit-reversed numbers, so
the last step of each coordinate reverses it. The index itself is the first coordinate, bit-reversed. ``SEED_X`` to ``SEED_W``
are mixed into the seed, so that each coordinate is scrambled by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.physics.samplers.base import ADAPTIVE, Points
from torchpt.physics.samplers.bits import (
    SEED_W,
    SEED_X,
    SEED_Y,
    SEED_Z,
    fourth_dimension,
    reverse_bits,
    scramble,
    second_dimension,
    third_dimension,
)

__all__ = ["Sobol"]


def _shuffled(key: Tensor, salt: Tensor | int) -> tuple[Tensor, Tensor]:
    """Return the seed of a set of dimensions, and the index of the lane's point in an order of that set, each ``(N,)`` int32.

    Owen scrambling of an index is a shuffle that keeps each aligned run of 2^k points together, so any first 2^k points of a
    pixel are still stratified: Burley's nested uniform shuffle.
    """
    pixel_seed, point = key[0], key[1]
    seed = mix(pixel_seed ^ salt)
    return seed, reverse_bits(scramble(reverse_bits(point), seed))


@dataclass(frozen=True)
class Sobol(Points):
    """An Owen-scrambled (0, 2)-sequence for each pixel and set of dimensions, for any number of samples."""

    name = "sobol"
    parameters = ADAPTIVE  # the scene key `adaptive`, which the renderer reads: no field
    joint = True  # `draw_further` continues sets of two numbers to four

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return the first coordinate of a shuffled point; arguments as for :meth:`Points.draw_1d`."""
        # Shuffled before scrambling: by scrambling alone all 1D sets would share their order and be correlated.
        seed, index = _shuffled(key, salt)
        return to_unit(reverse_bits(scramble(index, mix(seed ^ SEED_X))))

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return the first two coordinates of a shuffled point; arguments as for :meth:`Points.draw_1d`."""
        seed, index = _shuffled(key, salt)
        x = scramble(index, mix(seed ^ SEED_X))
        y = scramble(second_dimension(index), mix(seed ^ SEED_Y))
        return torch.stack((to_unit(reverse_bits(x)), to_unit(reverse_bits(y))))

    def draw_further(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return the third and fourth coordinate of the point of :meth:`draw_2d`: the same seed gives the same shuffle."""
        seed, index = _shuffled(key, salt)
        x = scramble(third_dimension(index), mix(seed ^ SEED_Z))
        y = scramble(fourth_dimension(index), mix(seed ^ SEED_W))
        return torch.stack((to_unit(reverse_bits(x)), to_unit(reverse_bits(y))))
