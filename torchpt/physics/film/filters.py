"""Reconstruction filters for filter importance sampling: the base class, and filters sampled by tabulated inversion.

The camera stage draws the film position of a sample as ``pixel centre + offset(u)``, with two random numbers ``u``; the sample
then counts for this pixel alone, times :meth:`Filter.weight`. A kind of filter, one file each in ``kinds/``, says its profile
and how to sample it; :class:`Tabulated` samples any profile.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.spec import Spec

__all__ = ["MAX_WIDTH", "Filter", "Tabulated"]

#: Widest filters in pixels, that tables of them are fine enough.
MAX_WIDTH = 1000.0


# ---- The base class


class Filter(ABC):
    """A separable, symmetric reconstruction filter, from which film positions are sampled.

    Separable: it is the product of one profile in x and in y. Both offsets are sampled from it by themselves.

    Args:
        values: values of all parameters by name.
        device: device of the lanes.

    Attributes:
        name: the ``type`` in a scene file.
        parameters: specs of the parameters.
        values: the values of all parameters by name.
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
        self._radius = torch.tensor(self.radius, dtype=torch.float32, device=device)  # the radius again, for lanes

    @abstractmethod
    def half_width(self) -> float:
        """Return the radius in pixels."""

    @abstractmethod
    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the filter along one axis at distances ``x`` from the centre in pixels, up to a constant factor."""

    @abstractmethod
    def offset(self, u: Tensor) -> Tensor:
        """Sample offsets along one axis by the magnitude of the profile.

        Args:
            u: random numbers in [0, 1), of any shape.

        Returns:
            Offsets from the pixel centre in pixels, in the shape of ``u``.
        """

    def weight(self, u: Tensor) -> Tensor:
        """Return weights ``(N,)`` of samples at the offsets of ``u (2, N)``; called only if ``signed``."""
        return torch.ones_like(u[0])

    def density(self, x: Tensor) -> Tensor:
        """Return the profile, of integral 1, at distances ``x (N,)`` from the centre in pixels; for light paths."""
        raise NotImplementedError

    def splat(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Choose along one axis a pixel that light at a film position counts for, by the profile about the pixels' centres.

        Args:
            x: positions ``(N,)`` in pixels from the film's edge.
            u: ``(N,)`` in [0, 1).

        Returns:
            Indices ``(N,)`` int64 of the pixels, which may lie beside the film, and weights ``(N,)``: the chance of a pixel
            times the weight is :meth:`density` about its centre.
        """
        first = torch.ceil(x - (self.radius + 0.5))  # the lowest pixel whose centre is within the radius
        values = [self.density(first + (k + 0.5) - x) for k in range(math.ceil(2.0 * self.radius))]
        total = torch.stack([value.abs() for value in values]).sum(0)
        bar, below = u * total, torch.zeros_like(total)
        index, weight = torch.zeros_like(first), total * torch.sign(values[0])
        for k, value in enumerate(values[1:], 1):
            below = below + values[k - 1].abs()
            here = (bar >= below) & (value != 0)
            index, weight = torch.where(here, float(k), index), torch.where(here, total * torch.sign(value), weight)
        return (first + index).to(torch.int64), weight

    def kind(self) -> tuple[object, ...]:
        """Return all that kernels depend on beside :meth:`tensors`, as a part of their cache key."""
        return self.name, self.signed

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that :meth:`offset` and :meth:`weight` read, by name."""
        return {"radius": self._radius}


# ---- Filters sampled by tabulated inversion, negative lobes included
#
# Where a filter is negative, offsets are sampled by its magnitude, and a sample's weight is the sign of the filter times the
# integral of the magnitude over that of the filter. The expected weight is 1: the estimate is unbiased, and samples do not
# depend on each other, as they would by division by the sum of weights.


#: Intervals of the table of the inverse CDF.
_CELLS = 4096
#: Numbers of samplers are multiples of one over this, so shifts that are multiples too keep them exact.
_STEPS = 1 << 24


class Tabulated(Filter):
    """A filter defined by its profile alone.

    Random numbers below a bound sample the intervals where the profile is negative, those above it the others: fewer interval
    ends keep stratified points better distributed. The table has its intervals in the order of offsets, so numbers are shifted,
    interval by interval, before it is read.
    """

    tabulated: ClassVar[bool] = True

    def __init__(self, values: Mapping[str, Any], device: torch.device) -> None:
        super().__init__(values, device)
        tables = _tables(_FilterKey(type(self), tuple(self.values.items()), self))

        def number(x: float) -> Tensor:
            return torch.tensor(x, dtype=torch.float32, device=device)

        self._inverse = torch.from_numpy(tables.inverse_cdf).to(device)
        self._profile = torch.from_numpy(tables.profile).to(device)
        self._negative = number(tables.negative_fraction)
        self._shifts = [(number(end), number(shift)) for end, shift in tables.shifts]
        self.signed = tables.negative_fraction > 0

    def kind(self) -> tuple[object, ...]:
        """Return the name, whether the filter is signed, and the number of shifts: :meth:`Filter.kind`."""
        return *super().kind(), len(self._shifts)

    def tensors(self) -> dict[str, Tensor]:
        """Return the radius, the table of the inverse CDF, the negative fraction and the shifts: :meth:`Filter.tensors`."""
        shifts = {}
        for k, (end, shift) in enumerate(self._shifts):
            shifts |= {f"end{k}": end, f"shift{k}": shift}
        return {
            **super().tensors(),
            "inverse": self._inverse,
            "profile": self._profile,
            "negative": self._negative,
            **shifts,
        }

    def offset(self, u: Tensor) -> Tensor:
        """Sample offsets by the shifted numbers and the table, read with linear interpolation: :meth:`Filter.offset`."""
        if self._shifts:
            *others, (_, last_shift) = self._shifts
            shifted = u + last_shift
            for end, shift in reversed(others):  # so that the first end above u wins
                shifted = torch.where(u < end, u + shift, shifted)
            u = shifted
        position = u * float(_CELLS)  # in cells of the table
        cell = position.to(torch.int64)
        low = torch.take(self._inverse, cell)
        return low + (torch.take(self._inverse, cell + 1) - low) * (position - cell)

    def density(self, x: Tensor) -> Tensor:
        """Return the profile by its table: :meth:`Filter.density`."""
        position = (x.abs() * (_CELLS / self.radius)).clamp_max(float(_CELLS))
        cell = position.to(torch.int64).clamp_max(_CELLS - 1)
        low = torch.take(self._profile, cell)
        return low + (torch.take(self._profile, cell + 1) - low) * (position - cell)

    def weight(self, u: Tensor) -> Tensor:
        """Return the sign of the filter at the offsets of ``u (2, N)``, times the integral of its magnitude over its own."""
        negative = u < self._negative  # (2, N): the profile is negative in x, in y
        norm = 1.0 / (1.0 - 2.0 * self._negative)
        return norm * norm * (1.0 - 2.0 * (negative[0] ^ negative[1]).to(u.dtype))


@dataclass(frozen=True)
class _FilterKey:
    """A filter as a cache key: equal for filters of one kind with the same values of parameters."""

    kind: type[Tabulated]
    values: tuple[tuple[str, Any], ...]
    filter: Tabulated = field(compare=False)


class _Tables(NamedTuple):
    """Tables for sampling a profile.

    Attributes:
        inverse_cdf: offsets in pixels ``(_CELLS + 1,)`` float32, the inverse CDF of the profile's magnitude at equal steps.
        profile: the filter, of integral 1, at ``_CELLS + 1`` equal steps from its centre to its radius, float32.
        negative_fraction: fraction of the magnitude's integral where the profile is negative, 0 to below 1/2.
        shifts: pairs ``(end, shift)``, ends ascending. The first shift whose end lies above a number is added to it, so that
            the lowest numbers fall into the negative intervals. Empty for a profile that is nowhere negative.
    """

    inverse_cdf: NDArray[np.float32]
    profile: NDArray[np.float32]
    negative_fraction: float
    shifts: tuple[tuple[float, float], ...]


@lru_cache(maxsize=16)  # takes milliseconds, which count in loops over small renders
def _tables(key: _FilterKey) -> _Tables:
    """Tabulate the profile of a filter, in float64."""
    radius = key.filter.radius
    x = np.linspace(-radius, radius, (1 << 16) + 1)  # 16 steps a cell, for an accurate integral
    weight = key.filter.profile(0.5 * (x[1:] + x[:-1]))
    cdf = np.concatenate(([0.0], np.cumsum(np.abs(weight))))
    inverse = np.interp(np.linspace(0.0, 1.0, _CELLS + 1), cdf / cdf[-1], x).astype(np.float32)
    step = 2.0 * radius / len(weight)
    values = key.filter.profile(np.linspace(0.0, radius, _CELLS + 1)) / (float(weight.sum()) * step)
    half_profile = values.astype(np.float32)
    # Sign changes on the left half, as numbers of steps; mirrored on the right.
    below = weight < 0
    half = len(weight) // 2
    left = [round(float(cdf[k + 1] / cdf[-1]) * _STEPS) for k in np.flatnonzero(below[1:half] != below[: half - 1])]
    ends = [0, *left, *(_STEPS - k for k in reversed(left)), _STEPS]
    # Intervals (first, end, whether the profile is negative there): signs alternate from one to the next.
    runs = [
        (first, end, (k % 2 == 0) == bool(below[0])) for k, (first, end) in enumerate(pairwise(ends)) if end > first
    ]
    # From the last to the first: so the leftmost one mostly moves as the positive interval beside it, with one shift for both.
    negative = [(first, end) for first, end, is_below in reversed(runs) if is_below]
    if not negative:
        return _Tables(inverse, half_profile, 0.0, ())
    order = [*negative, *((first, end) for first, end, is_below in runs if not is_below)]
    shifts: list[tuple[float, float]] = []
    total = 0  # steps before the interval, in the order of numbers
    for first, end in order:
        shift = (first - total) / _STEPS
        total += end - first
        if shifts and shifts[-1][1] == shift:  # the interval before moves alike: one entry for both
            shifts.pop()
        shifts.append((total / _STEPS, shift))
    return _Tables(inverse, half_profile, sum(end - first for first, end in negative) / _STEPS, tuple(shifts))
