"""What a case is, and what comes of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.stress.harness import Harness

__all__ = ["Case", "Measurement", "Outcome", "powers"]


@dataclass(frozen=True)
class Case:
    """Something that breaks path tracers, and what is to come of it.

    Attributes:
        name: a few words.
        measures: what the figure is, in a line; nothing is lost and nothing is wrong where it is 0.
        bound: the largest figure that passes.
        figure: of one place in the sweep. It may raise: that is a failure, and is told.
        axis: what is swept.
        sweep: values of it.
        quick: those that stand for all in a quick run; by default the first, the middle and the last.
        backend: whether the figure depends on how rays are searched and stages are run; else one run tells for all.
    """

    name: str
    measures: str
    bound: float
    figure: Callable[[Harness, float], float]
    axis: str = ""
    sweep: tuple[float, ...] = (0.0,)
    quick: tuple[float, ...] = ()
    backend: bool = True

    def points(self, quick: bool) -> tuple[float, ...]:
        """Places of a run."""
        if not quick:
            return self.sweep
        return self.quick or tuple(dict.fromkeys((self.sweep[0], self.sweep[len(self.sweep) // 2], self.sweep[-1])))


@dataclass(frozen=True)
class Measurement:
    """One figure.

    Attributes:
        at: the place in the sweep.
        figure: NaN where there is none.
        problem: why there is none.
        refused: whether the search that was asked for says itself that it is not for this scene.
    """

    at: float
    figure: float
    problem: str = ""
    refused: bool = False


@dataclass(frozen=True)
class Outcome:
    """Of a case.

    Attributes:
        case: which.
        readings: in the order of the sweep.
        seconds: that it took.
    """

    case: Case
    readings: tuple[Measurement, ...] = field(default=())
    seconds: float = 0.0

    @property
    def worst(self) -> Measurement:
        """The one that decides: a failure to measure, else the largest figure; a refusal where there is nothing else."""
        measured = [one for one in self.readings if not one.refused] or self.readings
        return max(measured, key=lambda one: math.inf if math.isnan(one.figure) else one.figure)

    @property
    def passed(self) -> bool:
        """Whether all figures that there are lie within the bound."""
        return all(one.refused or one.figure <= self.case.bound for one in self.readings)

    @property
    def refused(self) -> int:
        """At how many places the search refused the scene."""
        return sum(one.refused for one in self.readings)


def powers(low: int, high: int, step: int = 1) -> tuple[float, ...]:
    """``10^low .. 10^high``."""
    return tuple(10.0**k for k in range(low, high + 1, step))
