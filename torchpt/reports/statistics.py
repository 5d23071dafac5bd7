"""Means over seeds with their 95 % intervals, slopes, times to an error.

Intervals are Student's, of logarithms: a mean ``m`` of K runs with spread s has ``log m ± t s / (m √K)``, so no bound is
negative. What is made of several steps has the variance that theirs come to, with Satterthwaite's degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mpmath

__all__ = ["Estimate", "Fit", "Level", "estimate", "f_tail", "fit", "t_quantile"]

_LEVEL = 0.95


def f_tail(f: float, d1: float, d2: float) -> float:
    """The chance that Fisher's F of ``d1`` and ``d2`` degrees of freedom is larger than ``f``."""
    if not f > 0:
        return 1.0
    if math.isinf(f):
        return 0.0
    return float(mpmath.betainc(d2 / 2, d1 / 2, 0, d2 / (d2 + d1 * f), regularized=True))


@lru_cache(maxsize=4096)
def t_quantile(freedom: float, level: float = _LEVEL) -> float:
    """How many standard errors an interval of this level reaches to either side, by Student's t."""
    low, high = 0.0, 1.0
    while f_tail(high * high, 1.0, freedom) > 1 - level:
        low, high = high, 2 * high
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if f_tail(middle * middle, 1.0, freedom) > 1 - level else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; the bounds are None where nothing is known of it."""

    mean: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Level:
    """The logarithm of a step's error.

    Attributes:
        x: logarithm of what it is over: samples or seconds.
        y: logarithm of the mean.
        variance: of ``y``.
        freedom: its degrees.
    """

    x: float
    y: float
    variance: float
    freedom: float


def _moments(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and the variance of that mean."""
    count, mean = len(values), math.fsum(values) / len(values)
    if count < 2:
        return mean, math.nan
    return mean, math.fsum((x - mean) ** 2 for x in values) / (count - 1) / count


def estimate(values: Sequence[float], positive: bool = True) -> Estimate:
    """The mean of independent values with its interval, of the logarithm where they are ``positive`` quantities."""
    mean, variance = _moments(values)
    if len(values) < 2 or not math.isfinite(variance):
        return Estimate(mean)
    reach = t_quantile(len(values) - 1.0) * math.sqrt(variance)
    if not positive:
        return Estimate(mean, mean - reach, mean + reach)
    if mean <= 0:
        return Estimate(mean)
    factor = math.exp(min(reach / mean, 700.0))
    return Estimate(mean, mean / factor, mean * factor)


@dataclass(frozen=True)
class Fit:
    """A straight line through levels: ``y = middle_y + slope (x - middle_x)``.

    Attributes:
        slope: with its interval.
        middle: mean x and mean y of the levels.
        levels: what it was drawn through, in the order of x.
    """

    slope: Estimate
    middle: tuple[float, float]
    levels: tuple[Level, ...]

    def reach(self, y: float) -> tuple[Estimate, bool] | None:
        """Where the line comes down to ``y``, with its interval; whether that lies beyond the levels.

        None where the line does not fall. Without an interval where chance alone may have made it fall.
        """
        slope = self.slope.mean
        if not slope < 0:
            return None
        away = (y - self.middle[1]) / slope
        x = self.middle[0] + away
        share = 1.0 / len(self.levels)
        parts = [-(share + away * c) / slope for c in _slope_derivatives(self.levels)]  # derivative by each y
        falls = self.slope.high is not None and self.slope.high < 0  # else the line may never come down there
        spread = _combined(self.levels, parts) if falls else None
        beyond = not self.levels[0].x <= x <= self.levels[-1].x
        if spread is None:
            return Estimate(x), beyond
        return Estimate(x, x - spread, x + spread), beyond


def fit(xs: Sequence[float], values: Sequence[Sequence[float]]) -> Fit | None:
    """The line by least squares through the logarithms of means over seeds.

    Args:
        xs: samples or seconds of each step.
        values: errors of the step's runs. A step whose mean is not positive is left out: there the error drowned in the
            reference's own.

    Returns:
        None where fewer than two steps are left, or they have all the same x.
    """
    levels = []
    for x, step in zip(xs, values, strict=True):
        mean, variance = _moments(step)
        if mean > 0 and x > 0 and math.isfinite(mean):
            levels.append(Level(math.log(x), math.log(mean), variance / mean**2, len(step) - 1.0))
    levels.sort(key=lambda level: level.x)
    if len(levels) < 2 or levels[0].x == levels[-1].x:
        return None
    middle = math.fsum(v.x for v in levels) / len(levels), math.fsum(v.y for v in levels) / len(levels)
    pulls = _slope_derivatives(levels)
    slope = math.fsum(c * v.y for c, v in zip(pulls, levels, strict=True))
    spread = _combined(levels, pulls)
    bounds = () if spread is None else (slope - spread, slope + spread)
    return Fit(Estimate(slope, *bounds), middle, tuple(levels))


def _slope_derivatives(levels: Sequence[Level]) -> list[float]:
    """The derivative of the slope by each level's y."""
    middle = math.fsum(v.x for v in levels) / len(levels)
    square = math.fsum((v.x - middle) ** 2 for v in levels)
    return [(v.x - middle) / square for v in levels]


def _combined(levels: Sequence[Level], parts: Sequence[float]) -> float | None:
    """Half the interval of ``Σ part y``; None where a level has no spread."""
    shares = [part * part * level.variance for part, level in zip(parts, levels, strict=True)]
    total = math.fsum(shares)
    if not math.isfinite(total):
        return None
    if total == 0:
        return 0.0
    freedom = total**2 / math.fsum(s * s / v.freedom for s, v in zip(shares, levels, strict=True))
    return t_quantile(round(freedom, 1)) * math.sqrt(total)
