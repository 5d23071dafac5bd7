"""Means over seeds with 95 % intervals, slopes of error curves, and times to a given error.

Intervals are Student's, of logarithms: a mean ``m`` of K runs with spread s has ``log m ± t s / (m √K)``, so no bound is
negative. Variances of several steps are combined with Satterthwaite's degrees of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mpmath

__all__ = ["LARGEST_EXPONENT", "Estimate", "Fit", "Level", "estimate", "f_tail", "fit", "t_quantile"]

_LEVEL = 0.95  # confidence of all intervals
#: Largest exponent whose exponential a float64 holds (709.8), rounded down.
LARGEST_EXPONENT = 700.0


def f_tail(f: float, d1: float, d2: float) -> float:
    """Return the probability that Fisher's F of ``d1`` and ``d2`` degrees of freedom is larger than ``f``."""
    if not f > 0:
        return 1.0
    if math.isinf(f):
        return 0.0
    return float(mpmath.betainc(d2 / 2, d1 / 2, 0, d2 / (d2 + d1 * f), regularized=True))


@lru_cache(maxsize=4096)
def t_quantile(freedom: float, level: float = _LEVEL) -> float:
    """Return the half-width of a two-sided interval in standard errors, by Student's t with ``freedom`` degrees of freedom."""
    # Bisection: the square of a t has the distribution of an F with 1 and `freedom` degrees of freedom.
    low, high = 0.0, 1.0
    while f_tail(high * high, 1.0, freedom) > 1 - level:
        low, high = high, 2 * high
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if f_tail(middle * middle, 1.0, freedom) > 1 - level else (low, middle)
    return 0.5 * (low + high)


@dataclass(frozen=True)
class Estimate:
    """A number with its interval; the bounds are None if unknown."""

    mean: float
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class Level:
    """The mean error of a step, in logarithms.

    Attributes:
        x: logarithm of samples or seconds.
        y: logarithm of the mean error.
        variance: variance of ``y``.
        freedom: degrees of freedom of ``variance``.
    """

    x: float
    y: float
    variance: float
    freedom: float


def _moments(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean, and the variance of the mean."""
    count, mean = len(values), math.fsum(values) / len(values)
    if count < 2:
        return mean, math.nan
    return mean, math.fsum((x - mean) ** 2 for x in values) / (count - 1) / count


def estimate(values: Sequence[float], *, positive: bool = True) -> Estimate:
    """Return the mean of independent values with its interval; of the logarithm for ``positive`` quantities."""
    mean, variance = _moments(values)
    if len(values) < 2 or not math.isfinite(variance):
        return Estimate(mean)
    half_width = t_quantile(len(values) - 1.0) * math.sqrt(variance)
    if not positive:
        return Estimate(mean, low=mean - half_width, high=mean + half_width)
    if mean <= 0:
        return Estimate(mean)
    factor = math.exp(min(half_width / mean, LARGEST_EXPONENT))
    return Estimate(mean, low=mean / factor, high=mean * factor)


@dataclass(frozen=True)
class Fit:
    """A straight line through levels: ``y = middle_y + slope (x - middle_x)``.

    Attributes:
        slope: the slope with its interval.
        middle: mean x and mean y of the levels.
        levels: the fitted levels, in the order of x.
    """

    slope: Estimate
    middle: tuple[float, float]
    levels: tuple[Level, ...]

    def x_at(self, y: float) -> tuple[Estimate, bool] | None:
        """Return the x with its interval at which the line falls to ``y``, and True if that lies outside of the levels.

        None if the line does not fall. Without an interval if its fall is not significant.
        """
        slope = self.slope.mean
        if not slope < 0:
            return None
        middle_x, middle_y = self.middle
        from_middle = (y - middle_y) / slope
        x = middle_x + from_middle
        # Derivatives of x by each level's y: middle_y is the mean of all y, and the slope depends on them too.
        share = 1.0 / len(self.levels)
        derivatives = [-(share + from_middle * c) / slope for c in _slope_derivatives(self.levels)]
        falls = self.slope.high is not None and self.slope.high < 0  # otherwise the line may never reach y
        half_width = _half_width(self.levels, derivatives) if falls else None
        is_outside = not self.levels[0].x <= x <= self.levels[-1].x
        if half_width is None:
            return Estimate(x), is_outside
        return Estimate(x, low=x - half_width, high=x + half_width), is_outside


def fit(xs: Sequence[float], values: Sequence[Sequence[float]]) -> Fit | None:
    """Fit a line by least squares to the logarithms of means over seeds.

    Args:
        xs: samples or seconds of each step.
        values: errors of each step's runs. A step whose mean is not positive is left out: its error is below the noise of
            the reference.

    Returns:
        None if fewer than two steps are left, or all have the same x.
    """
    levels = []
    for x, step in zip(xs, values, strict=True):
        mean, variance = _moments(step)
        if mean > 0 and x > 0 and math.isfinite(mean):
            # The variance of a logarithm is the relative variance, to first order.
            levels.append(Level(x=math.log(x), y=math.log(mean), variance=variance / mean**2, freedom=len(step) - 1.0))
    levels.sort(key=lambda level: level.x)
    if len(levels) < 2 or levels[0].x == levels[-1].x:
        return None
    middle = math.fsum(v.x for v in levels) / len(levels), math.fsum(v.y for v in levels) / len(levels)
    derivatives = _slope_derivatives(levels)  # the slope is linear in the y
    slope = math.fsum(c * v.y for c, v in zip(derivatives, levels, strict=True))
    half_width = _half_width(levels, derivatives)
    bounds = () if half_width is None else (slope - half_width, slope + half_width)
    return Fit(slope=Estimate(slope, *bounds), middle=middle, levels=tuple(levels))


def _slope_derivatives(levels: Sequence[Level]) -> list[float]:
    """Return the derivative of the slope by each level's y."""
    middle = math.fsum(v.x for v in levels) / len(levels)
    square = math.fsum((v.x - middle) ** 2 for v in levels)
    return [(v.x - middle) / square for v in levels]


def _half_width(levels: Sequence[Level], derivatives: Sequence[float]) -> float | None:
    """Return the half-width of the interval of a quantity with these derivatives by each level's y.

    None if a level's variance is unknown.
    """
    shares = [c * c * level.variance for c, level in zip(derivatives, levels, strict=True)]
    total = math.fsum(shares)
    if not math.isfinite(total):
        return None
    if total == 0:
        return 0.0
    freedom = total**2 / math.fsum(s * s / v.freedom for s, v in zip(shares, levels, strict=True))
    return t_quantile(round(freedom, 1)) * math.sqrt(
        total
    )  # rounded, so that the cache of t_quantile has it more often
