"""What a picture knows of its own error, from pilots: pixels with two independent values.

A pilot's first value A is sampled as every pixel is, its second value B by other random numbers. ``(A - B)² / 2`` has the
mean of A's variance, whatever sampler made them. relMSE divides it by ``r² + 0.01`` with the true radiance r; the median of A,
B and the mean of the eight pixels around stands for it.

Where few pixels carry the error (caustics, edges of bright lights) pilots say little: they meet few such pixels or none, and
two values do not tell r. So some pixels are looked at again, by several more streams that are no part of the picture:

- *suspects*: the pixels that stand out most from their second brightest neighbour, wherever they are. Of each the error that
  the picture really has is then known, so what sparkles in the picture is counted and not guessed.
- *doubtful pilots*: those whose two values differ most, for the r that theirs is divided by.

The interval is that of the mean over pilots, symmetric in its logarithm, as errors are squares and lean to the right. It is
called heavy-tailed, and is not to be trusted, where suspects have most of the error, where the standard error is half of the
estimate, or where the largest errors of pilots have a tail too heavy for a mean (:mod:`torchpt.film.tail`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.film.pilots import Pilots
from torchpt.film.tail import FEWEST as TAIL
from torchpt.film.tail import heavy_tail
from torchpt.images.metrics import relative

__all__ = [
    "STREAMS",
    "Again",
    "KnownError",
    "again_counts",
    "around",
    "error_at",
    "error_by_pilots",
    "known_error",
    "pilots_alone",
    "to_look_at",
]

#: Pilots from which on an interval is given.
FEWEST = 8
#: Part of the error that suspects may have, and that its standard error may be, before the interval is called heavy-tailed.
FEW, VAGUE = 0.5, 0.5
#: One of so many pixels is a suspect, one of so many pilots doubtful.
SUSPECTS, DOUBTFUL = 1024, 64
#: Streams that they are looked at again by.
STREAMS = 8
#: Further values may all miss a light that few samples meet: r is taken for no less than this part of a pilot's mean, or of a
#: suspect's value.
BRIGHTER, BRIGHTEST = 4.0, 32.0


@dataclass(frozen=True)
class KnownError:
    """An estimate of relMSE, the mean of ``(x - r)² / (r² + 0.01)`` over pixels and channels.

    Attributes:
        relmse: of the picture.
        interval: of 95 % for it; None for a handful of pilots.
        heavy_tailed: whether so few pixels carry the error that the interval is not to be trusted.
    """

    relmse: float
    interval: tuple[float, float] | None
    heavy_tailed: bool


def around(values: Tensor, known: Tensor) -> Tensor:
    """The mean of the eight neighbours of each place ``(H, W, C)``, of those that are ``known (H, W)``.

    Where one has none its own value stands.
    """
    height, width, _ = values.shape
    there = known.to(values.dtype)
    total, count = torch.zeros_like(values), torch.zeros_like(there)
    padded = torch.nn.functional.pad((values * there[..., None]), (0, 0, 1, 1, 1, 1))
    marks = torch.nn.functional.pad(there, (1, 1, 1, 1))
    for dy in range(3):
        for dx in range(3):
            if (dx, dy) != (1, 1):
                total += padded[dy : dy + height, dx : dx + width]
                count += marks[dy : dy + height, dx : dx + width]
    return torch.where(count[..., None] > 0, total / count.clamp_min(1.0)[..., None], values)


def error_at(a: Tensor, b: Tensor, near: Tensor) -> Tensor:
    """Squared error of each pilot's first value ``(n, C)`` over ``r² + 0.01``, as two values tell it.

    Args:
        a: first values ``(n, C)``.
        b: second values.
        near: what lies around.
    """
    radiance = torch.stack((a, b, near)).median(0).values
    return relative((a - b).square() / 2, radiance)


def error_by_pilots(pilots: Pilots, a: Tensor, b: Tensor) -> Tensor:
    """:func:`error_at` with the mean of the pilots around for what lies around, mean of the channels ``(n,)``."""
    grid = a.new_zeros(*pilots.blocks, a.shape[1])
    known = torch.zeros(pilots.blocks, dtype=torch.bool)
    at = tuple(pilots.block)
    grid[at], known[at] = (a + b) / 2, True
    return error_at(a, b, around(grid, known)[at]).mean(1)


def pilots_alone(pilots: Pilots, a: Tensor, b: Tensor, spare: Tensor | None, counted: bool) -> KnownError:
    """By the pilots alone, so that no other pixel has a say: the relMSE that decisions are made by."""
    share = error_by_pilots(pilots, a, b) * _first_part(a, b, spare)
    pixels = float(sum_all(pilots.weight))
    part = 1.0 - 0.5 * len(pilots) / pixels if counted else 1.0
    mean = float(sum_all(share * pilots.weight)) / pixels
    parts = pilots.weight / pixels * (share - mean) * part
    return _with_interval(mean * part, parts, 0.0, False, share)


@dataclass(frozen=True)
class Again:
    """Pixels that were looked at again.

    Attributes:
        places: which pixels of the picture ``(m,)`` int64; suspects first, then pilots in their order.
        suspects: how many of them are suspects; the others are pilots.
        mean: of their further values ``(m, C)``.
        spare: the variance of that mean.
    """

    places: Tensor
    suspects: int
    mean: Tensor
    spare: Tensor


def again_counts(pixels: int, pilots: int) -> tuple[int, int]:
    """Return how many suspects and how many doubtful pilots are looked at again, at most."""
    return max(pixels // SUSPECTS, 1), max(pilots // DOUBTFUL, 4)


def to_look_at(picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Which pixels are to be looked at again: suspects, and doubtful pilots; places ``(m,)`` on the picture.

    Args:
        picture: ``(H, W, C)`` float64.
        pilots: n of them.
        a: their first values ``(n, C)``.
        b: their second values.
    """
    suspects = _suspects(picture)
    rest = ~torch.isin(pilots.places, suspects)
    low = torch.minimum(a, b).clamp_min(0.0)
    doubt = relative((a - b).square(), low).mean(1) * rest
    count = min(again_counts(len(rest), len(pilots))[1], int(rest.sum()))
    return suspects, pilots.places[doubt.topk(count).indices.sort().values]


def _suspects(picture: Tensor) -> Tensor:
    """The pixels that stand out most, of those that are brighter than seven of their neighbours."""
    bright = picture.sum(2)
    padded = torch.nn.functional.pad(bright, (1, 1, 1, 1), value=-math.inf)
    height, width = bright.shape
    brighter = torch.zeros(height, width, dtype=torch.int8)
    for dy in range(3):
        for dx in range(3):
            brighter += padded[dy : dy + height, dx : dx + width] > bright
    few = (brighter.reshape(-1) <= 1).nonzero()[:, 0]
    standing = _standing_out(picture.reshape(-1, picture.shape[2])[few], _neighbours(picture, few))
    count, _ = again_counts(bright.numel(), 0)
    return few[standing.topk(min(count, len(few))).indices].sort().values


def known_error(
    picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor, spare: Tensor | None, counted: bool, again: Again | None
) -> KnownError | None:
    """The error that a picture knows.

    Args:
        picture: ``(H, W, C)`` float64, on the CPU.
        pilots: n of them.
        a: their first values ``(n, C)``.
        b: their second values.
        spare: an estimate of the variance of ``b`` where it is not that of first values.
        counted: whether second values are part of the picture, as half of each pilot.
        again: what was looked at again; None: nothing yet.

    Returns:
        The estimate; None where there is no pilot.
    """
    if not len(pilots):
        return None
    flat, places = picture.reshape(-1, picture.shape[2]), pilots.places
    others = _neighbours(picture, places)
    near = others.mean(0)
    first = _first_part(a, b, spare)
    sure, unsure, rest = 0.0, 0.0, torch.ones(len(pilots), dtype=torch.bool)
    suspects = places[:0]
    if again is not None:
        suspects = again.places[: again.suspects]
        sure, unsure = _really(flat[suspects], again.mean[: again.suspects], again.spare[: again.suspects])
        rest = ~torch.isin(places, suspects)
        # A second value that would be a suspect itself tells of others like it, which are counted already.
        least = _standing_out(flat[suspects], _neighbours(picture, suspects)).min() if len(suspects) else math.inf
        b = torch.where((_standing_out(b, others) > least)[:, None], near, b)
    share = error_at(a, b, near)
    if again is not None:
        at = torch.isin(places, again.places[again.suspects :])  # in the order of the pilots, both
        radiance = torch.maximum(again.mean[again.suspects :].abs(), ((a[at] + b[at]) / 2 / BRIGHTER).abs())
        share[at] = relative((a[at] - b[at]).square() / 2, radiance)
    share = share.mean(1)[rest] * first
    if not len(share):
        return None
    pixels = len(flat)
    part = (pixels - len(suspects)) / pixels * (1.0 - 0.5 * len(pilots) / pixels if counted else 1.0)
    weight = pilots.weight[rest] / sum_all(pilots.weight[rest])
    mean = float(sum_all(weight * share))
    parts = weight * (share - mean) * part
    total = sure / pixels + mean * part
    return _with_interval(total, parts, unsure / pixels**2, sure / pixels > FEW * total, share)


def _first_part(a: Tensor, b: Tensor, spare: Tensor | None) -> float:
    """Twice the part that first values have in the variance of differences; 1 where second values are like them.

    Second values made of two streams of half the length vary more, as Sobol' points gain by being more. How much is told by all
    pilots together, and it is no less than a half and no more than double.
    """
    if spare is None:
        return 1.0
    scale = relative(1.0, (a + b) / 2)
    both, second = (float(sum_all((x * scale).clamp_max(1.0))) for x in ((a - b).square(), spare))
    return 2.0 * min(max(1.0 - second / both, 1 / 3), 0.5) if both > 0.0 else 1.0


def _neighbours(picture: Tensor, places: Tensor) -> Tensor:
    """The eight neighbours ``(8, n, C)`` of pixels; beyond the edge the nearest pixel stands for them."""
    height, width, channels = picture.shape
    x, y = places % width, torch.div(places, width, rounding_mode="floor")
    steps = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy]
    at = [(y + dy).clamp(0, height - 1) * width + (x + dx).clamp(0, width - 1) for dx, dy in steps]
    return picture.reshape(-1, channels)[torch.stack(at)]


def _standing_out(values: Tensor, others: Tensor) -> Tensor:
    """By how much ``values (n, C)`` exceed the second brightest of ``others (8, n, C)``, relative to their mean ``(n,)``."""
    second = others.topk(2, 0).values[1]
    return relative((values - second).clamp_min(0.0).square(), others.mean(0)).mean(1)


def _really(values: Tensor, mean: Tensor, spare: Tensor) -> tuple[float, float]:
    """The squared error that pixels have, over ``r² + 0.01``, in all, and the variance of that.

    Args:
        values: of the picture ``(m, C)``.
        mean: of further values.
        spare: its variance.
    """
    radiance, apart = torch.maximum(mean.abs(), values.abs() / BRIGHTEST), values - mean
    share = relative(apart.square() - spare, radiance)
    # To the first order in the mean: channels move together, so their deviations add up.
    slope = relative(2 * apart.abs() + 2 * radiance * share.abs(), radiance)
    return float(sum_all(share.mean(1))), float(sum_all((slope * spare.sqrt()).mean(1).square()))


def _with_interval(mean: float, parts: Tensor, unsure: float, few: bool, share: Tensor) -> KnownError:
    """The estimate with its interval.

    Args:
        mean: the estimate.
        parts: the pilots' deviations, whose sum of squares is their variance.
        unsure: variance from suspects.
        few: whether suspects carry most of the error.
        share: the pilots' errors.
    """
    count = len(parts)
    if not mean > 0.0 or not math.isfinite(mean):
        return KnownError(mean, (0.0, 0.0) if mean == 0.0 and count >= FEWEST else None, not math.isfinite(mean))
    if count < FEWEST:
        return KnownError(mean, None, True)
    deviation = math.sqrt(float(sum_all(parts.square())) + unsure)
    heavy = few or deviation > VAGUE * mean or (count >= TAIL and heavy_tail(share))
    factor = math.exp(min(_quantile(count - 1) * deviation / mean, 300.0))
    return KnownError(mean, (mean / factor, mean * factor), heavy)


def _quantile(freedom: int) -> float:
    """Student's t at 97.5 % (Abramowitz and Stegun 26.7.5, to the second term)."""
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
