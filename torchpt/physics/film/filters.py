"""Reconstruction filters by importance sampling; those that come as a table of their inverse."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.spec import Spec

__all__ = ["Filter", "Tabulated"]


# ---- What a kind of reconstruction filter must say


class Filter(ABC):
    """A separable, symmetric reconstruction filter that is sampled: a sample's place is drawn from it.

    Args:
        values: of its parameters by name, all of them.
        device: where the lanes live.

    Attributes:
        name: its ``type`` in a scene file.
        parameters: what it declares.
        values: of its parameters.
        radius: half width in pixels, beyond which it is zero.
        signed: whether it is negative anywhere, so that samples have weights; else every weight is 1.
        tabulated: whether lanes read its inverse from a table.
        jumps: whether it ends at its radius by a jump.
    """

    name: ClassVar[str] = ""
    parameters: ClassVar[Mapping[str, Spec]] = {}
    tabulated: ClassVar[bool] = False
    jumps: ClassVar[bool] = False
    signed: bool = False

    def __init__(self, values: Mapping[str, Any], device: torch.device) -> None:
        self.values = dict(values)
        self.radius = self.half_width()
        self._radius = torch.tensor(self.radius, dtype=torch.float32, device=device)

    @abstractmethod
    def half_width(self) -> float:
        """In pixels."""

    @abstractmethod
    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The filter along one axis at distances ``x`` from the middle, in pixels; any scale, zero beyond its radius."""

    @abstractmethod
    def offset(self, u: Tensor) -> Tensor:
        """Places in pixels from the pixel's centre for ``u`` in [0, 1), any shape, as dense as the profile's magnitude."""

    def weight(self, u: Tensor) -> Tensor:
        """Weights ``(N,)`` of the samples at the offsets of ``u (2, N)``; asked for only where it is ``signed``."""
        return torch.ones_like(u[0])

    def kind(self) -> tuple[object, ...]:
        """What is not a tensor: kernels are made anew where it differs."""
        return self.name, self.signed

    def tensors(self) -> dict[str, Tensor]:
        """What lanes read."""
        return {"radius": self._radius}


# ---- Filters drawn from by a table of the inverse of their cumulative profile, negative lobes included
#
# Where a filter is negative, places are drawn from its magnitude and a sample is weighted by the filter's sign times the
# integral of the magnitude over that of the filter. The weight's expectation is 1: constants are kept without bias, and no
# sample depends on another as it would where sums are divided by sums of weights.


_CELLS = 4096
#: Numbers in [0, 1) are multiples of one over this.
_STEPS = 1 << 24


class Tabulated(Filter):
    """A filter of which only the profile is said.

    Its runs of negative values are drawn by the lowest numbers, whole steps of them: the fewer ends of intervals, the more
    evenly stratified points share them out. So numbers are moved about, a run at a time, before the table is read.
    """

    tabulated: ClassVar[bool] = True

    def __init__(self, values: Mapping[str, Any], device: torch.device) -> None:
        super().__init__(values, device)
        inverse, negative, moves = _tables(_Profile(type(self), tuple(self.values.items()), self))

        def number(x: float) -> Tensor:
            return torch.tensor(x, dtype=torch.float32, device=device)

        self._inverse = torch.from_numpy(inverse).to(device)
        self._negative = number(negative)
        self._moves = [(number(end), number(by)) for end, by in moves]
        self.signed = negative > 0

    def kind(self) -> tuple[object, ...]:
        """See :meth:`Filter.kind`."""
        return *super().kind(), len(self._moves)

    def tensors(self) -> dict[str, Tensor]:
        """See :meth:`Filter.tensors`."""
        moves = {f"{name}{k}": pair[i] for k, pair in enumerate(self._moves) for i, name in enumerate(("end", "by"))}
        return {**super().tensors(), "inverse": self._inverse, "negative": self._negative, **moves}

    def offset(self, u: Tensor) -> Tensor:
        """See :meth:`Filter.offset`."""
        if self._moves:
            *others, (_, last) = self._moves
            moved = u + last
            for end, by in reversed(others):
                moved = torch.where(u < end, u + by, moved)
            u = moved
        place = u * float(_CELLS)
        cell = place.to(torch.int64)
        low = torch.take(self._inverse, cell)
        return low + (torch.take(self._inverse, cell + 1) - low) * (place - cell)

    def weight(self, u: Tensor) -> Tensor:
        """See :meth:`Filter.weight`."""
        negative = u < self._negative
        norm = 1.0 / (1.0 - 2.0 * self._negative)
        return norm * norm * (1.0 - 2.0 * (negative[0] ^ negative[1]).to(u.dtype))


Moves = tuple[tuple[float, float], ...]
Tables = tuple[NDArray[np.float32], float, Moves]


@dataclass(frozen=True)
class _Profile:
    """A profile as a key: filters of one kind with the same values have the same."""

    kind: type[Tabulated]
    values: tuple[tuple[str, Any], ...]
    filter: Tabulated = field(compare=False)


@lru_cache(maxsize=16)  # takes milliseconds, which small renders repeated in a loop would notice
def _tables(profile: _Profile) -> Tables:
    """The inverse of the cumulative magnitude, the share of it that is negative, and moves of numbers.

    The inverse is made in float64 to be read linearly. Of the moves ``(end, by)``, the first whose end lies beyond a number
    says what is added to it, so that the lowest numbers come to lie in the negative runs.
    """
    radius = profile.filter.radius
    x = np.linspace(-radius, radius, (1 << 16) + 1)
    weight = profile.filter.profile(0.5 * (x[1:] + x[:-1]))
    cdf = np.concatenate(([0.0], np.cumsum(np.abs(weight))))
    inverse = np.interp(np.linspace(0.0, 1.0, _CELLS + 1), cdf / cdf[-1], x).astype(np.float32)
    # Where the sign changes on the left, in whole steps; on the right mirrored.
    below = weight < 0
    half = len(weight) // 2
    left = [round(float(cdf[k + 1] / cdf[-1]) * _STEPS) for k in np.flatnonzero(below[1:half] != below[: half - 1])]
    ends = [0, *left, *(_STEPS - k for k in reversed(left)), _STEPS]
    runs = [
        (first, end, (k % 2 == 0) == bool(below[0])) for k, (first, end) in enumerate(pairwise(ends)) if end > first
    ]
    negative = [(first, end) for first, end, is_below in reversed(runs) if is_below]
    if not negative:
        return inverse, 0.0, ()
    order = [*negative, *((first, end) for first, end, is_below in runs if not is_below)]
    moves: list[tuple[float, float]] = []
    total = 0
    for first, end in order:
        by = (first - total) / _STEPS
        total += end - first
        if moves and moves[-1][1] == by:
            moves.pop()
        moves.append((total / _STEPS, by))
    return inverse, sum(end - first for first, end in negative) / _STEPS, tuple(moves)
