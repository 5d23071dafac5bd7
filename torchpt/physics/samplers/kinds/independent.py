"""Independent uniform numbers by counter-based hashing: no state, no order.

A key has two rows: seed of the pixel, index of the point.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, to_unit
from torchpt.physics.samplers.base import ADAPTIVE, Points

__all__ = ["Independent"]

#: Flips bits of the first word, whose hash is then the second: any odd constant would do (2^32 over the golden ratio).
_SECOND = as_int32(0x9E3779B9)


def _word(key: Tensor, salt: Tensor | int) -> Tensor:
    """Return a hash ``(N,)`` int32 of seed, point and dimension."""
    # Two rounds: the first hashes the sample index with the salt, the second adds the pixel. So two lanes share a number only
    # if both rounds collide, and then in this dimension alone.
    return mix(mix(key[1] ^ salt) + key[0])


@dataclass(frozen=True)
class Independent(Points):
    """Independent random numbers, for comparisons and for tests."""

    name = "independent"
    parameters = ADAPTIVE  # the scene key `adaptive`, which the renderer reads: no field

    def draw_1d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return a uniform number; arguments as for :meth:`Points.draw_1d`."""
        return to_unit(_word(key, salt))

    def draw_2d(self, key: Tensor, salt: Tensor | int) -> Tensor:
        """Return two uniform numbers; arguments as for :meth:`Points.draw_1d`."""
        word = _word(key, salt)
        return torch.stack((to_unit(word), to_unit(mix(word ^ _SECOND))))
