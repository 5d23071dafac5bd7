"""Jittered points: one in each of n strata, in an order of its own for each dimension.

In two dimensions the strata are arranged in ``round(sqrt(n))`` columns with nearly equal numbers of strata and widths in
proportion: all strata have the same area and are nearly square, for any n (primes included).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import mix, to_unit
from torchpt.physics.samplers.base import Points
from torchpt.physics.samplers.bits import X, Y, jittered, place, shuffle

__all__ = ["Stratified"]


@dataclass(frozen=True)
class Stratified(Points):
    """Jittered: one point in each of n strata of equal area, nearly square, for any n."""

    name = "stratified"
    needs_count = True
    rows = 3

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_1d`."""
        return jittered(key, salt)

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """See :meth:`Points.draw_2d`."""
        seed = mix(key[0] ^ salt)
        stratum = shuffle(key[1], key[2], seed)
        jitter = to_unit(mix(mix(seed ^ X) ^ stratum)).double(), to_unit(mix(mix(seed ^ Y) ^ stratum)).double()
        # Integers below 2^53, so that quotients are floored correctly.
        k, count = stratum.double(), key[2].double()
        columns = (count.sqrt() + 0.5).floor()
        column = (((k + 1.0) * columns - 1.0) / count).floor()
        first, end = (column * count / columns).floor(), ((column + 1.0) * count / columns).floor()
        rows = end - first
        return torch.stack((place(first, jitter[0] * rows, count), place(k - first, jitter[1], rows)))
