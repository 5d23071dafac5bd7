"""Jittered points: one in each of n strata, in an order of its own for each dimension.

In two dimensions the strata are arranged in ``round(sqrt(n))`` columns with nearly equal numbers of strata and widths in
proportion: all strata have the same area and are nearly square, for any n (primes included).

The key of a sample has three rows: seed of the pixel, index of the point, number n of points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.physics.samplers.base import Points
from torchpt.physics.samplers.bits import SEED_X, SEED_Y, jittered, point_in_stratum, shuffle

__all__ = ["Stratified"]


@dataclass(frozen=True)
class Stratified(Points):
    """Jittered: one point in each of n strata of equal area, nearly square, for any n."""

    name = "stratified"
    needs_count = True  # the number of points must be known beforehand
    rows = 3  # of a key

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return a jittered number, one in each of n intervals; arguments as for :meth:`Points.draw_1d`."""
        return jittered(key, salt)

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return a jittered point, one in each of n strata; arguments as for :meth:`Points.draw_1d`."""
        pixel_seed, point, points = key[0], key[1], key[2]
        seed = mix(pixel_seed ^ salt)
        stratum = shuffle(point, points, seed)
        jitter_x = to_unit(mix(mix(seed ^ SEED_X) ^ stratum)).double()
        jitter_y = to_unit(mix(mix(seed ^ SEED_Y) ^ stratum)).double()
        # Integers below 2^53, so that quotients are floored correctly.
        k, count = stratum.double(), points.double()
        columns = (count.sqrt() + 0.5).floor()
        column = (((k + 1.0) * columns - 1.0) / count).floor()  # the one whose strata include k
        first, end = (column * count / columns).floor(), ((column + 1.0) * count / columns).floor()
        rows = end - first  # strata of the column, which is `rows / count` wide
        x = point_in_stratum(first, jitter_x * rows, count)
        return torch.stack((x, point_in_stratum(k - first, jitter_y, rows)))
