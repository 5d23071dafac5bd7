"""Hammersley points ``(i / n, van der Corput(i))``, padded: each set of dimensions is shuffled and scrambled separately.

The second coordinate is Owen-scrambled rather than rotated (Cranley-Patterson): a rotation moves points across elementary
intervals, and leaves the same grid in every pixel; scrambling keeps one point in every interval and lets the variance of smooth
integrands fall faster than ``n^-2``. For the same reason the first is jittered within its stratum. The order is a permutation
of any length, so sets of dimensions are independent and ``n`` need not be a power of two.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.physics.samplers.base import Points
from torchpt.physics.samplers.bits import X, Y, jittered, place, reverse_bits, scramble, shuffle

__all__ = ["Hammersley"]


@dataclass(frozen=True)
class Hammersley(Points):
    """``(i/n, van der Corput)``, the first jittered, the second Owen-scrambled, for a fixed number n of points."""

    name = "hammersley"
    needs_count = True
    rows = 3

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_1d`."""
        return jittered(key, salt)

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_2d`."""
        seed = mix(key[0] ^ salt)
        index = shuffle(key[1], key[2], seed)
        x = place(index.double(), to_unit(mix(mix(seed ^ X) ^ index)).double(), key[2].double())
        return torch.stack((x, to_unit(reverse_bits(scramble(index, mix(seed ^ Y))))))
