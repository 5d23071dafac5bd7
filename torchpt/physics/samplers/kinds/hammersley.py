"""Hammersley points ``(i / n, van der Corput(i))``, padded: each set of dimensions is shuffled and scrambled separately.

The key of a sample has three rows: seed of the pixel, index of the point, number n of points.

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
from torchpt.physics.samplers.bits import SEED_X, SEED_Y, jittered, point_in_stratum, reverse_bits, scramble, shuffle

__all__ = ["Hammersley"]


@dataclass(frozen=True)
class Hammersley(Points):
    """``(i/n, van der Corput)``, the first jittered, the second Owen-scrambled, for a fixed number n of points."""

    name = "hammersley"
    needs_count = True  # the number of points must be known beforehand
    rows = 3  # of a key

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return a jittered number, one in each of n intervals; arguments as for :meth:`Points.draw_1d`."""
        return jittered(key, salt)

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return a point of the shuffled and scrambled set; arguments as for :meth:`Points.draw_1d`."""
        pixel_seed, point, count = key[0], key[1], key[2]
        seed = mix(pixel_seed ^ salt)
        index = shuffle(point, count, seed)
        x = point_in_stratum(index.double(), to_unit(mix(mix(seed ^ SEED_X) ^ index)).double(), count.double())
        return torch.stack((x, to_unit(reverse_bits(scramble(index, mix(seed ^ SEED_Y))))))
