"""Arithmetic for ``bench_mitsuba.py``: errors against a noisy reference, and errors at a given time."""

from __future__ import annotations

import bisect
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

#: relMSE is the mean of ``(x - ref)^2 / (ref^2 + FLOOR)`` over pixels and channels, as ``torchpt.images.metrics.FLOOR`` has it.
FLOOR = 1e-2
#: Scenes of few primitives, and of meshes or many lights.
SIMPLE = ("cornell_box", "veach_mis", "material_row", "cornell_transmissive")
MESHES = ("cornell_bunny", "env_teapot", "studio", "many_lights", "clutter", "shapes_and_maps")
GROUPS = {"simple": SIMPLE, "meshes": MESHES, "all": (*SIMPLE, *MESHES)}
SCENES = GROUPS["all"]


def geometric_means(figures: Mapping[str, float]) -> dict[str, float]:
    """Return the geometric means of the complete groups; `figures` are by scene."""
    return {
        group: math.exp(statistics.fmean(math.log(figures[name]) for name in names))
        for group, names in GROUPS.items()
        if set(names) <= set(figures)
    }


@dataclass(frozen=True)
class Reference:
    """The mean of several pictures, used as a reference.

    Attributes:
        mean: ``(H, W, 3)``.
        variance: variance of that mean, ``(H, W, 3)``, estimated from the spread of the pictures.
        without: one reference per picture that leaves that picture out; empty for fewer than three pictures.
    """

    mean: np.ndarray
    variance: np.ndarray
    without: tuple[Reference, ...] = ()

    @staticmethod
    def of(pictures: Sequence[np.ndarray]) -> Reference:
        """Build the reference from two or more pictures ``(H, W, 3)`` of independent seeds."""
        if len(pictures) < 2:
            raise ValueError(f"a reference takes two pictures or more to know its own variance, got {len(pictures)}")
        stack = np.stack([np.asarray(picture, np.float64) for picture in pictures])
        number, mean = len(stack), stack.mean(0)
        squares = (stack - mean) ** 2
        total = squares.sum(0)
        without = [
            Reference(
                mean + (mean - picture) / (number - 1),
                (total - number / (number - 1) * square) / ((number - 1) * (number - 2)),
            )
            for picture, square in zip(stack, squares, strict=True)
            if number > 2
        ]
        return Reference(mean, total / (number * (number - 1)), tuple(without))

    def relmse(self, picture: np.ndarray, scale: np.ndarray) -> float:
        """Return the relMSE of a picture that is not part of the reference, unbiased by the reference's noise.

        Args:
            picture: ``(H, W, 3)``.
            scale: divisor of squared errors, ``(H, W, 3)``.
        """
        squares = (np.asarray(picture, np.float64) - self.mean) ** 2
        return float(((squares - self.variance) / scale).mean())


def scale_of(a: Reference, b: Reference) -> np.ndarray:
    """Return the divisor of squared errors: the same for both references, and less noisy than one of them alone."""
    return (0.5 * (a.mean + b.mean)) ** 2 + FLOOR


def between(a: Reference, b: Reference) -> float:
    """Estimate the relMSE between two references without their noise; for equal ones it scatters about 0."""
    squares = (a.mean - b.mean) ** 2 - a.variance - b.variance
    return float((squares / scale_of(a, b)).mean())


@dataclass(frozen=True)
class Point:
    """Cost and error of a number of samples.

    Attributes:
        spp: samples a pixel.
        seconds: time of a picture, the median over rounds.
        relmse: error of one picture, the mean over seeds.
        deviation: standard error of ``relmse``, from its seeds and the reference's; None for a single seed.
    """

    spp: int
    seconds: float
    relmse: float
    deviation: float | None

    @staticmethod
    def of(spp: int, seconds: Sequence[float], errors: Sequence[float], without: Sequence[Sequence[float]]) -> Point:
        """Build a point from the turns with a number of samples.

        Args:
            spp: samples a pixel.
            seconds: seconds of each turn.
            errors: relMSE of each turn.
            without: for each turn, the relMSE against each of :attr:`Reference.without`.
        """
        deviation = None
        if len(errors) > 1:
            means = np.asarray(without, np.float64).reshape(len(errors), -1).mean(0)
            # Jackknife variance over the pictures of the reference; it is biased upwards (Efron and Stein, 1981).
            reference = (len(means) - 1) * float(means.var()) if len(means) else 0.0
            deviation = math.sqrt(statistics.variance(errors) / len(errors) + reference)
        return Point(spp, statistics.median(seconds), statistics.fmean(errors), deviation)


@dataclass(frozen=True)
class Estimate:
    """A relMSE estimated at a time.

    Attributes:
        relmse: the error.
        deviation: its standard error; None for a single seed.
        spp: samples a pixel that fit into the time, by the same interpolation.
        within: True if the time lies between two measured points.
    """

    relmse: float
    deviation: float | None
    spp: float
    within: bool


def at_time(points: Sequence[Point], seconds: float) -> Estimate:
    """Interpolate the error at a time, linearly in logarithms between the two nearest points that bracket it.

    Beyond the first or last point the error is extrapolated as one over the time, as for independent samples.

    Raises:
        ValueError: fewer than two points, or an error that is not positive (the reference was too noisy).
    """
    if len(points) < 2:
        raise ValueError(f"a line takes two points, got {len(points)}")
    line = sorted(points, key=lambda point: point.seconds)
    nearest = line[0] if seconds < line[0].seconds else line[-1]
    within = line[0].seconds <= seconds <= line[-1].seconds
    if not within and nearest.relmse > 0.0:
        longer = seconds / nearest.seconds
        deviation = None if nearest.deviation is None else nearest.deviation / longer
        return Estimate(nearest.relmse / longer, deviation, nearest.spp * longer, within)
    after = min(max(bisect.bisect_left([point.seconds for point in line], seconds), 1), len(line) - 1)
    low, high = line[after - 1], line[after]
    if low.relmse <= 0.0 or high.relmse <= 0.0:
        raise ValueError("no error is left once the reference's variance is subtracted: it takes more rounds")
    weight = math.log(seconds / low.seconds) / math.log(high.seconds / low.seconds)
    relmse = math.exp((1.0 - weight) * math.log(low.relmse) + weight * math.log(high.relmse))
    deviation = None
    if low.deviation is not None and high.deviation is not None:
        shares = ((1.0 - weight) * low.deviation / low.relmse, weight * high.deviation / high.relmse)
        deviation = relmse * math.hypot(*shares)
    spp = math.exp((1.0 - weight) * math.log(low.spp) + weight * math.log(high.spp))
    return Estimate(relmse, deviation, spp, within)


def better(errors: Mapping[str, float]) -> str:
    """Return the name with the least error; the first of equal ones."""
    return min(errors, key=lambda name: errors[name])


def samples_in(seconds: float, taken: int, took: float) -> int:
    """Return how many samples a pixel fit in a time if ``taken`` of them took ``took`` seconds; at least one."""
    return max(1, round(taken * seconds / took))
