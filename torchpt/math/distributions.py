"""Distributions by their cumulative sums, kept in float64: a float32 sum of many weights collapses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor

from torchpt.math.threads import sum_all
from torchpt.math.vectors import take

__all__ = ["Cells", "Discrete", "Spans", "invert_linear"]


@dataclass(frozen=True)
class Spans:
    """Where each of S arrays lies among all of them, one after another.

    Attributes:
        first: ``(S + 1,)`` int64, where each begins, and the end of all.
        longest: how many numbers the longest has; static.
    """

    first: Tensor
    longest: int

    @staticmethod
    def of(sizes: Sequence[int], device: torch.device) -> Spans:
        """Of arrays of these lengths."""
        return Spans(torch.tensor([0, *accumulate(sizes)], device=device), max(sizes))

    def begin(self, of: Tensor) -> Tensor:
        """Where the arrays ``of (N,)`` begin."""
        return take(self.first, of)

    def last(self, of: Tensor) -> Tensor:
        """Where the last number of the arrays ``of (N,)`` lies."""
        return take(self.first, of + 1) - 1

    def search(self, values: Tensor, v: Tensor, of: Tensor) -> Tensor:
        """How many numbers of the sorted array ``of`` are not above ``v (N,)``: torch.searchsorted on the right, by array."""
        begin, last = self.begin(of), self.last(of)
        low, high = begin, last + 1
        for _ in range(self.longest.bit_length()):
            middle = (low + high) >> 1
            # Where nothing is left to search, low and high are one place, which may be that after the last.
            above = take(values, torch.minimum(middle, last)) > v
            searching = low < high
            low = torch.where(searching & ~above, middle + 1, low)
            high = torch.where(searching & above, middle, high)
        return low - begin


@dataclass(frozen=True)
class Discrete:
    """Choice among K outcomes; or of several such choices the one that a lane has.

    Attributes:
        cdf: ``(K,)`` float64, the upper end of each outcome's interval; the last is 1.
        pmf: ``(K,)`` probabilities in the lanes' dtype.
        spans: where several choices lie one after another; None: there is one.
    """

    cdf: Tensor
    pmf: Tensor
    spans: Spans | None = None

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

    @staticmethod
    def joined(choices: Sequence[Discrete]) -> Discrete:
        """Several choices, of which each lane has one."""
        spans = Spans.of([len(choice.pmf) for choice in choices], choices[0].pmf.device)
        return Discrete(torch.cat([c.cdf for c in choices]), torch.cat([c.pmf for c in choices]), spans)

    def sample(self, u: Tensor, of: Tensor | None = None) -> Tensor:
        """Outcomes ``(N,)`` int64 for ``u`` in ``[0, 1]``; one of probability 0 is never drawn.

        ``of``: here and below, where there are several choices, which one each lane has ``(N,)`` int64.
        """
        u = u.double().clamp_max(1.0 - 2.0**-53)
        if self.spans is None or of is None:
            return torch.searchsorted(self.cdf, u, right=True)
        return self.spans.search(self.cdf, u, of)

    def draw(self, u: Tensor, of: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Outcomes ``(N,)``, and what is left of ``u``: ``(N,)`` in [0, 1], uniform whatever was drawn."""
        row = self.sample(u, of)
        place = self._place(row, of)
        low = torch.where(row > 0, take(self.cdf, (place - 1).clamp_min(0)), 0.0)
        width = take(self.cdf, place) - low
        return row, ((u - low) / torch.where(width > 0, width, 1.0)).clamp(0.0, 1.0)

    def chance(self, outcome: Tensor, of: Tensor | None = None) -> Tensor:
        """Probabilities ``(N,)`` of outcomes."""
        return take(self.pmf, self._place(outcome, of))

    def chance_of_last(self, of: Tensor | None = None) -> Tensor:
        """The probability of the last outcome: ``()``, or of several choices ``(N,)``."""
        return self.pmf[-1] if self.spans is None or of is None else take(self.pmf, self.spans.last(of))

    def _place(self, outcome: Tensor, of: Tensor | None) -> Tensor:
        return outcome if self.spans is None or of is None else outcome + self.spans.begin(of)


@dataclass(frozen=True)
class Cells:
    """Choice of a cell of an R x C grid, rows first; what a draw leaves over is a fresh number within the cell.

    The cells' preimages are rectangles of the unit square, so points that are stratified there stay so.

    Attributes:
        rows: ``(R + 1,)`` float64 cumulative sums over the rows, from 0 to 1.
        columns: ``(R C + 1,)`` float64: row number plus the cumulative sums within that row. It never falls, so that one
            binary search finds a cell of any row.
        width: ``()`` int64 C.
        spans: where several grids follow each other, those of their ``rows`` and of their ``columns``; None: there is one.
        which: of several the one that each lane has ``(N,)``; ``width`` is the lanes' too then.
    """

    rows: Tensor
    columns: Tensor
    width: Tensor
    spans: tuple[Spans, Spans] | None = None
    which: Tensor | None = None

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
        if self.spans is None:
            row = torch.searchsorted(self.rows, v[1], right=True) - 1
            across = v[0] + row
            cell = torch.searchsorted(self.columns, across, right=True) - 1
            left = _within(self.columns, cell, across), _within(self.rows, row, v[1])
        else:
            (rows, columns), of = self.spans, self.which
            assert of is not None
            row = rows.search(self.rows, v[1], of) - 1
            across = v[0] + row
            cell = columns.search(self.columns, across, of) - 1
            left = (
                _within(self.columns, cell + columns.begin(of), across),
                _within(self.rows, row + rows.begin(of), v[1]),
            )
        return row, cell - row * self.width, torch.stack(left).to(u.dtype)


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
