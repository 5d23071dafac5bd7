"""Reconstruction filters for filter importance sampling: the base class, and filters sampled by tabulated inversion."""

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


# ---- The base class


class Filter(ABC):
    """A separable, symmetric reconstruction filter, from which film positions are sampled.

    Args:
        values: values of all parameters by name.
        device: device of the lanes.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters.
        values: values of the parameters by name.
        radius: half width in pixels, beyond which the filter is zero.
        signed: whether the filter is negative anywhere, so that samples have weights; else every weight is 1.
        tabulated: whether :meth:`offset` reads a table of the inverse CDF.
        jumps: whether the filter is discontinuous at its radius.
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
        """Return the radius in pixels."""

    @abstractmethod
    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the filter along one axis at distances ``x`` from the centre, in pixels and at any scale."""

    @abstractmethod
    def offset(self, u: Tensor) -> Tensor:
        """Sample offsets from the pixel centre, in pixels, by the magnitude of the profile; ``u`` in [0, 1) has any shape."""

    def weight(self, u: Tensor) -> Tensor:
        """Return weights ``(N,)`` of samples at the offsets of ``u (2, N)``; called only if ``signed``."""
        return torch.ones_like(u[0])

    def kind(self) -> tuple[object, ...]:
        """Return what is no tensor, as part of the cache key of kernels."""
        return self.name, self.signed

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that :meth:`offset` and :meth:`weight` read, by name."""
        return {"radius": self._radius}


# ---- Filters sampled by tabulated inversion, negative lobes included
#
# Where a filter is negative, offsets are sampled by its magnitude, and a sample's weight is the sign of the filter times the
# integral of the magnitude over that of the filter. The expected weight is 1: the estimate is unbiased, and samples do not
# depend on each other, as they would by division by the sum of weights.


_CELLS = 4096
#: Numbers of samplers are multiples of one over this.
_STEPS = 1 << 24


class Tabulated(Filter):
    """A filter defined by its profile alone.

    Intervals of negative values are sampled by the lowest numbers: fewer interval ends keep stratified points better
    distributed. So numbers are shifted, interval by interval, before the table is read.
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
    """A profile as a cache key: equal for filters of one kind with the same values."""

    kind: type[Tabulated]
    values: tuple[tuple[str, Any], ...]
    filter: Tabulated = field(compare=False)


@lru_cache(maxsize=16)  # takes milliseconds, which count in loops over small renders
def _tables(profile: _Profile) -> Tables:
    """Return the inverse CDF of the magnitude, the fraction of it that is negative, and shifts of numbers.

    The inverse is computed in float64 and read with linear interpolation. The first shift ``(end, by)`` whose end lies above a
    number is added to it, so that the lowest numbers fall into the negative intervals.
    """
    radius = profile.filter.radius
    x = np.linspace(-radius, radius, (1 << 16) + 1)
    weight = profile.filter.profile(0.5 * (x[1:] + x[:-1]))
    cdf = np.concatenate(([0.0], np.cumsum(np.abs(weight))))
    inverse = np.interp(np.linspace(0.0, 1.0, _CELLS + 1), cdf / cdf[-1], x).astype(np.float32)
    # Sign changes on the left half, in whole steps; mirrored on the right.
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
