"""Records of a stress test (a case), of its figures along a sweep, and of its result.

A case measures one figure, an error, at each point of a sweep of one quantity (a scale, a distance, ...). All figures must be
at most the bound of the case.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.stress.harness import Harness

__all__ = ["Case", "Measurement", "Outcome", "powers_of_ten"]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A stress test: a figure that must be small at all points of a sweep.

    Attributes:
        name: the name in tables.
        measures: what the figure is, in a line; 0 is perfect. "relative" is the relative error of the mean of the picture.
        bound: the largest figure that passes.
        figure: returns the figure at a point of the sweep. An exception is a failure, and is reported.
        axis: name of the swept quantity; "" for a case of a single point, whose number means nothing.
        sweep: the points of the sweep.
        quick_sweep: points of a quick run; by default the first, the middle and the last of ``sweep``.
        uses_backend: True if the figure depends on search and engine; else one run is enough.
    """

    name: str
    measures: str
    bound: float
    figure: Callable[[Harness, float], float]
    axis: str = ""
    sweep: tuple[float, ...] = (0.0,)
    quick_sweep: tuple[float, ...] = ()
    uses_backend: bool = True

    def points(self, *, quick: bool) -> tuple[float, ...]:
        """Return the points of the whole sweep, or of a quick run."""
        if not quick:
            return self.sweep
        first, middle, last = self.sweep[0], self.sweep[len(self.sweep) // 2], self.sweep[-1]
        return self.quick_sweep or tuple(dict.fromkeys((first, middle, last)))  # each once


@dataclass(frozen=True)
class Measurement:
    """The figure at one point of a sweep.

    Attributes:
        at: the point of the sweep.
        figure: the figure; NaN if there is none.
        problem: why there is no figure.
        refused: True if the search structure refused the scene.
    """

    at: float
    figure: float
    problem: str = ""
    refused: bool = False


@dataclass(frozen=True)
class Outcome:
    """The result of a case.

    Attributes:
        case: the case.
        readings: the figures in the order of the sweep.
        seconds: run time of all points.
    """

    case: Case
    readings: tuple[Measurement, ...] = ()
    seconds: float = 0.0

    @property
    def worst(self) -> Measurement:
        """Measurement that decides: a failure (NaN), else the largest figure; a refusal if there is nothing else."""
        measured = [one for one in self.readings if not one.refused] or self.readings
        return max(measured, key=lambda one: math.inf if math.isnan(one.figure) else one.figure)

    @property
    def passed(self) -> bool:
        """True if all figures are within the bound; refusals are ignored."""
        return all(one.refused or one.figure <= self.case.bound for one in self.readings)

    @property
    def refusals(self) -> int:
        """Number of points at which the search refused the scene."""
        return sum(one.refused for one in self.readings)


def powers_of_ten(low: int, high: int, *, step: int = 1) -> tuple[float, ...]:
    """Return the powers of ten from ``10^low`` to ``10^high``, each ``10^step`` times the one before."""
    return tuple(10.0**exponent for exponent in range(low, high + 1, step))
