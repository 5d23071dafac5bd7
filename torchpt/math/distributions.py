"""A discrete distribution by its cumulative sums, kept in float64: a float32 sum of many weights collapses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Discrete"]


@dataclass(frozen=True)
class Discrete:
    """Choice among K outcomes.

    Attributes:
        cdf: ``(K,)`` float64, the upper end of each outcome's interval; the last is 1.
        pmf: ``(K,)`` probabilities in the lanes' dtype.
    """

    cdf: Tensor
    pmf: Tensor

    @staticmethod
    def of(weights: Tensor, dtype: torch.dtype, even: float = 0.01) -> Discrete:
        """From non-negative weights ``(K,)``; all zero gives the uniform choice.

        Args:
            weights: ``(K,)``.
            dtype: of ``pmf``.
            even: share of the draws that is even among the outcomes with any weight. A draw has 24 bits: an outcome rarer
                than that would never come up, or too often.
        """
        w = weights.detach().double()
        total = w.sum()
        uniform = torch.full_like(w, 1.0 / max(len(w), 1))
        possible = (w > 0).double()
        floor = possible / possible.sum().clamp_min(1.0)
        w = torch.where(total > 0, (1.0 - even) * w / torch.where(total > 0, total, 1.0) + even * floor, uniform)
        cdf = torch.cumsum(w, 0)
        # From the last possible outcome on the sum is 1, so that rounding never lets a draw fall on an impossible one.
        last = int((w > 0).nonzero().max())
        cdf[last:] = 1.0
        return Discrete(cdf, w.to(dtype))

    def sample(self, u: Tensor) -> Tensor:
        """Outcomes ``(N,)`` int64 for ``u`` in ``[0, 1)``; one of probability 0 is never drawn."""
        return torch.searchsorted(self.cdf, u.double(), right=True).clamp_max(len(self.cdf) - 1)
