"""Random numbers of edges: a function of (seed, number of the sample, dimension), and places drawn by weight."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, mix_int
from torchpt.math.vectors import take

__all__ = ["Choice", "Numbers"]


class Numbers:
    """Numbers in [0, 1) of samples.

    Args:
        seed: any integer.
        stream: tells estimators of one seed apart.
    """

    def __init__(self, seed: int, stream: int) -> None:
        self._seed = mix_int(mix_int(mix_int(seed) ^ as_int32(seed >> 32)) + stream)

    def of(self, sample: Tensor, dimension: int) -> Tensor:
        """``(N,)`` float64, multiples of ``2^-32``, of samples ``(N,)`` int64."""
        word = mix(mix(sample.to(torch.int32) ^ mix_int(self._seed + dimension)) + self._seed)
        return (word.double() + 2.0**31) * 2.0**-32


class Choice:
    """Choice among weights ``(K,)``, the place within the chosen one included.

    Args:
        weights: non-negative, one of them positive.
    """

    def __init__(self, weights: Tensor) -> None:
        self._upper = torch.cumsum(weights.double(), 0)
        self.weights, self.total = weights.double(), float(self._upper[-1])
        self._last = int((weights > 0).nonzero().max())

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Outcomes ``(N,)`` for ``u`` in [0, 1), what is left of ``u``, and their chances."""
        v = u * self.total
        index = torch.searchsorted(self._upper, v, right=True).clamp_max(self._last)
        weight = take(self.weights, index)
        rest = (v - (take(self._upper, index) - weight)) / torch.where(weight > 0, weight, 1.0)
        return index, rest.clamp(0.0, 1.0 - 2.0**-40), weight / self.total
