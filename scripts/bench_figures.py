"""The arithmetic of ``bench_mitsuba.py``: errors against a reference that is noisy itself, and at a given time."""

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
    """Of the groups that are complete; figures by scene."""
    return {
        group: math.exp(statistics.fmean(math.log(figures[name]) for name in names))
        for group, names in GROUPS.items()
        if set(names) <= set(figures)
    }


@dataclass(frozen=True)
class Reference:
    """A mean over pictures.

    Attributes:
        mean: ``(H, W, 3)``.
        variance: of that mean, ``(H, W, 3)``, as the pictures' spread tells.
        without: the references that each lack one of the pictures; none of fewer than three pictures.
    """

    mean: np.ndarray
    variance: np.ndarray
    without: tuple[Reference, ...] = ()

    @staticmethod
    def of(pictures: Sequence[np.ndarray]) -> Reference:
        """Of two pictures ``(H, W, 3)`` or more, of independent seeds."""
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
        """Of a picture that has no part in the reference, without bias by the reference's noise.

        Args:
            picture: ``(H, W, 3)``.
            scale: what squared errors are divided by, ``(H, W, 3)``.
        """
        squares = (np.asarray(picture, np.float64) - self.mean) ** 2
        return float(((squares - self.variance) / scale).mean())


def scale_of(a: Reference, b: Reference) -> np.ndarray:
    """What squared errors of both are divided by: the same for both, and less noisy than one of them alone."""
    return (0.5 * (a.mean + b.mean)) ** 2 + FLOOR


def between(a: Reference, b: Reference) -> float:
    """The relMSE that two references would have without noise: 0 but for chance where both tell the same, also below 0."""
    squares = (a.mean - b.mean) ** 2 - a.variance - b.variance
    return float((squares / scale_of(a, b)).mean())


@dataclass(frozen=True)
class Point:
    """What a number of samples costs and gives.

    Attributes:
        spp: samples a pixel.
        seconds: a picture takes, the median over rounds.
        relmse: of one picture, the mean over seeds.
        deviation: standard error of ``relmse``, by its seeds and the reference's; None where there was one seed.
    """

    spp: int
    seconds: float
    relmse: float
    deviation: float | None

    @staticmethod
    def of(spp: int, seconds: Sequence[float], errors: Sequence[float], without: Sequence[Sequence[float]]) -> Point:
        """Of the turns with this number of samples.

        Args:
            spp: samples a pixel.
            seconds: of the turns.
            errors: their relMSE.
            without: by turn, the relMSE against each of :attr:`Reference.without`.
        """
        deviation = None
        if len(errors) > 1:
            means = np.asarray(without, np.float64).reshape(len(errors), -1).mean(0)
            # The jackknife: how much each picture of the reference matters. It errs upwards (Efron and Stein, 1981).
            reference = (len(means) - 1) * float(means.var()) if len(means) else 0.0
            deviation = math.sqrt(statistics.variance(errors) / len(errors) + reference)
        return Point(spp, statistics.median(seconds), statistics.fmean(errors), deviation)


@dataclass(frozen=True)
class Estimate:
    """A relMSE at a time.

    Attributes:
        relmse: the error.
        deviation: its standard error; None where there was one seed.
        spp: samples a pixel that fit, by the same line.
        within: whether times were measured on both sides.
    """

    relmse: float
    deviation: float | None
    spp: float
    within: bool


def at_time(points: Sequence[Point], seconds: float) -> Estimate:
    """The error at a time, on the straight line in logarithms through the two nearest points that bracket it.

    Beyond the first or last point the error goes on from there as one over the time, as that of independent samples does.

    Raises:
        ValueError: fewer than two points, or an error that is not positive: its reference was too noisy.
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
    """Whose error is least; the first where several have it."""
    return min(errors, key=lambda name: errors[name])


def samples_in(seconds: float, taken: int, took: float) -> int:
    """How many samples a pixel fit in a time where ``taken`` of them took ``took`` seconds: one at least."""
    return max(1, round(taken * seconds / took))
