"""Owen-scrambled digital sequences, padded: each set of dimensions is shuffled separately.

Sets of one or two dimensions are Sobol' points. The numbers of a light sample and those of the direction that led to its
vertex (or of the film position) are the two halves of a set of four dimensions, stratified together.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.physics.samplers.base import ADAPTIVE, Points
from torchpt.physics.samplers.bits import (
    W,
    X,
    Y,
    Z,
    fourth_dimension,
    reverse_bits,
    scramble,
    second_dimension,
    third_dimension,
)

__all__ = ["Sobol"]


@dataclass(frozen=True)
class Sobol(Points):
    """An Owen-scrambled (0, 2)-sequence for each pixel and set of dimensions, for any number of samples."""

    name = "sobol"
    parameters = ADAPTIVE
    joint = True

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_1d`."""
        # Shuffled before scrambling: by scrambling alone all 1D sets would share their order and be correlated.
        seed = mix(key[0] ^ salt)
        index = reverse_bits(scramble(reverse_bits(key[1]), seed))
        return to_unit(reverse_bits(scramble(index, mix(seed ^ X))))

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_2d`."""
        seed = mix(key[0] ^ salt)
        index = reverse_bits(scramble(reverse_bits(key[1]), seed))
        x = scramble(index, mix(seed ^ X))
        y = scramble(second_dimension(index), mix(seed ^ Y))
        return torch.stack((to_unit(reverse_bits(x)), to_unit(reverse_bits(y))))

    def draw_further(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_further`."""
        seed = mix(key[0] ^ salt)
        index = reverse_bits(scramble(reverse_bits(key[1]), seed))
        x = scramble(third_dimension(index), mix(seed ^ Z))
        y = scramble(fourth_dimension(index), mix(seed ^ W))
        return torch.stack((to_unit(reverse_bits(x)), to_unit(reverse_bits(y))))
