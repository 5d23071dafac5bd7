"""Distributions by their cumulative sums, kept in float64: a float32 sum of many weights collapses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.math.vectors import take

__all__ = ["Cells", "Discrete", "invert_linear"]


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
        total = sum_all(w)
        uniform = torch.full_like(w, 1.0 / max(len(w), 1))
        possible = (w > 0).double()
        floor = possible / possible.sum().clamp_min(1.0)
        w = torch.where(total > 0, (1.0 - even) * w / torch.where(total > 0, total, 1.0) + even * floor, uniform)
        cdf = torch.cumsum(w, 0)
        # From the last possible outcome on the sum is 1, so that rounding never lets a draw fall on an impossible one.
        last = int((w > 0).nonzero().max())
        cdf[last:] = 1.0
        return Discrete(cdf, w.to(dtype))

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return outcomes ``(N,)`` int64 for ``u (N,)`` in ``[0, 1]``, and what is left of ``u``, float64 in ``[0, 1]``.

        One of probability 0 is never drawn. What is left is uniform whatever was chosen.
        """
        outcome = torch.searchsorted(self.cdf, u.double().clamp_max(1.0 - 2.0**-53), right=True)
        low = torch.where(outcome > 0, take(self.cdf, (outcome - 1).clamp_min(0)), 0.0)
        width = take(self.cdf, outcome) - low
        return outcome, ((u - low) / torch.where(width > 0, width, 1.0)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class Cells:
    """Choice of a cell of an R x C grid, rows first; what a draw leaves over is a fresh number within the cell.

    The cells' preimages are rectangles of the unit square, so points that are stratified there stay so.

    Attributes:
        rows: ``(R + 1,)`` float64 cumulative sums over the rows, from 0 to 1.
        columns: ``(R C + 1,)`` float64: row number plus the cumulative sums within that row. It never falls, so that one
            binary search finds a cell of any row.
        width: ``()`` int64 C.
    """

    rows: Tensor
    columns: Tensor
    width: Tensor

    @staticmethod
    def of(weights: Tensor) -> Cells:
        """From non-negative weights ``(R, C)`` of which one is positive."""
        w = weights.detach().double()
        number = w.shape[0]
        along = torch.cumsum(w, 1)
        total = along[:, -1:]
        # A row without weight is never asked.
        along = torch.where(total > 0, along / torch.where(total > 0, total, 1.0), 1.0)
        along += torch.arange(number, dtype=w.dtype, device=w.device)[:, None]
        down = torch.cumsum(total[:, 0], 0)
        zero = down.new_zeros(1)
        width = torch.tensor(w.shape[1], dtype=torch.int64, device=w.device)
        return Cells(torch.cat((zero, down / down[-1])), torch.cat((zero, along.reshape(-1))), width)

    def sample(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows and columns ``(N,)`` int64 for ``u (2, N)`` in ``[0, 1)``, and what is left ``(2, N)``: columns by ``u[0]``.

        A cell without weight is never drawn.
        """
        # Just below 1 a row number plus u would round to the next row.
        v = u.double().contiguous().clamp_max(1.0 - 2.0**-32)
        row = torch.searchsorted(self.rows, v[1], right=True) - 1
        across = v[0] + row
        cell = torch.searchsorted(self.columns, across, right=True) - 1
        rest = torch.stack((_within(self.columns, cell, across), _within(self.rows, row, v[1])))
        return row, cell - row * self.width, rest.to(u.dtype)


def _within(cdf: Tensor, index: Tensor, v: Tensor) -> Tensor:
    """Where ``v`` lies in the interval ``index``, in ``[0, 1)``."""
    low, high = take(cdf, index), take(cdf, index + 1)
    return (v - low) / (high - low)


def invert_linear(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """``x`` in ``[0, 1]`` distributed as ``a (1 - x) + b x``, for ``u`` in ``[0, 1)``; ``a, b >= 0`` and not both 0.

    The root of the quadratic in the form that does not cancel. Where rounding made both 0, x is 0.
    """
    largest = torch.maximum(a, b)
    scale = torch.where(largest > 0, largest, 1.0)
    a, b = a / scale, b / scale
    bottom = a + torch.addcmul(a * a, b * b - a * a, u).clamp_min(0.0).sqrt()
    return (u * (a + b) / torch.where(bottom > 0, bottom, 1.0)).clamp_max(1.0)
