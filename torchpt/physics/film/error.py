"""What a picture knows of its own error: pilots, tails, intervals, and where adaptive sampling spends samples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.threads import sum_all
from torchpt.images.metrics import relative
from torchpt.math.hashing import as_int32, mix, mix_int, to_unit

__all__ = [
    "BLOCK",
    "MIN_TAIL_VALUES",
    "STREAMS",
    "ErrorEstimate",
    "Pilots",
    "Resampled",
    "allocate_samples",
    "around",
    "error_at",
    "error_by_pilots",
    "error_estimate",
    "expected_errors",
    "heavy_tail",
    "pilots_of",
    "pixels_to_resample",
    "probe_estimate",
    "resample_counts",
]


# ---- The tail of a distribution: how far a mean of so many values can be trusted
#
# The largest values are fitted by a generalized Pareto distribution, whose moments below 1 / k exist: from a shape k of 1/2 on
# it has no variance, from 1 on no mean. The fit is that of Zhang and Stephens (2009), *A New and Efficient Estimation Method
# for the Generalized Pareto Distribution*, Technometrics 51(3). How many values count as the tail, the weak prior and the
# threshold are those of Vehtari, Simpson, Gelman, Yao and Gabry (2024), *Pareto Smoothed Importance Sampling*, JMLR 25(72).


#: Fewest values whose tail a shape is fitted to.
MIN_TAIL_VALUES = 25
#: Weight of the prior, and the shape that it expects.
_PRIOR, _EXPECTED = 10.0, 0.5


def heavy_tail(values: Tensor) -> bool:
    """Return True where the upper tail of ``values (n,)``, n >= ``MIN_TAIL_VALUES``, is too heavy for their mean to be trusted.

    That is, whether its shape exceeds the threshold by more than chance explains: by two standard errors ``(1 + k) / sqrt(m)``
    of a shape fitted to m values.
    """
    ordered = np.sort(values.detach().cpu().double().numpy())
    count = int(min(0.2 * len(ordered), 3.0 * math.sqrt(len(ordered))))
    excess = ordered[-count:] - ordered[-count - 1]
    if not excess[-1] > 0.0:
        return False
    # Values alike have no logarithms of their differences; below this they weigh nothing.
    shape = _fitted(np.maximum(excess, 1e-30 * excess[-1]))
    shape = (count * shape + _PRIOR * _EXPECTED) / (count + _PRIOR)
    least = shape - 2.0 * (1.0 + abs(shape)) / math.sqrt(count + _PRIOR)
    return least > min(1.0 - 1.0 / math.log10(len(ordered)), 0.7)


def _fitted(x: NDArray[np.float64]) -> float:
    """Return the posterior mean of the shape of a generalized Pareto distribution of ``x (n,)``, positive and rising."""
    n = len(x)
    m = 30 + math.isqrt(n)
    quartile = x[int(n / 4 + 0.5) - 1]
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-theta[:, None] * x).mean(1)
    likelihood = n * (np.log(-theta / k) - k - 1.0)
    weight = 1.0 / np.exp(np.minimum(likelihood - likelihood[:, None], 700.0)).sum(1)
    mean = float((theta * weight).sum() / weight.sum())
    return float(np.log1p(-mean * x).mean())


# ---- Pilots: one pixel of each block of 4 x 4 that is sampled a second time, by other random numbers
#
# The difference of two independent values of a pixel is its error, whatever sampler made them. Where the pilots lie depends on
# the seed and on the film alone: a crop has those of the whole film that lie in it.


#: Side of a block in pixels.
BLOCK = 4
_NAME = 0x50494C4F


@dataclass(frozen=True)
class Pilots:
    """The pilots of a picture; n of them, one for each block of which it holds the pilot.

    Attributes:
        places: which pixels they are ``(n,)`` int64, row by row.
        weight: pixels that each stands for ``(n,)`` float64.
        block: row and column of their blocks ``(2, n)`` int64.
        blocks: rows and columns of blocks that the picture touches.
        corner: of the picture within its first block, ``(x, y)`` in pixels.
    """

    places: Tensor
    weight: Tensor
    block: Tensor
    blocks: tuple[int, int]
    corner: tuple[int, int]

    def __len__(self) -> int:
        return len(self.places)


def pilots_of(seed: int, film: tuple[int, int], crop: tuple[int, int, int, int]) -> Pilots:
    """The pilots of a crop ``(x, y, width, height)`` of a film ``(width, height)``."""
    x0, y0, width, height = crop
    first = x0 // BLOCK, y0 // BLOCK
    columns, rows = -(-(x0 + width) // BLOCK) - first[0], -(-(y0 + height) // BLOCK) - first[1]
    row, column = (
        grid.reshape(-1)
        for grid in torch.meshgrid(torch.arange(rows) + first[1], torch.arange(columns) + first[0], indexing="ij")
    )
    # Blocks at the film's edge hold fewer pixels.
    wide, high = (film[0] - BLOCK * column).clamp_max(BLOCK), (film[1] - BLOCK * row).clamp_max(BLOCK)
    number = (row * -(-film[0] // BLOCK) + column).to(torch.int32)
    named = as_int32(mix_int(mix_int(seed) ^ as_int32(seed >> 32)) ^ _NAME)
    drawn = (to_unit(mix(mix(number) ^ named)).double() * wide * high).long()
    x, y = BLOCK * column + drawn % wide - x0, BLOCK * row + torch.div(drawn, wide, rounding_mode="floor") - y0
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    block = torch.stack((row - first[1], column - first[0]))[:, inside]
    return Pilots(
        (y * width + x)[inside],
        (wide * high)[inside].double(),
        block,
        (rows, columns),
        (x0 - BLOCK * first[0], y0 - BLOCK * first[1]),
    )


# ---- What a picture knows of its own error, from pilots: pixels with two independent values
#
# A pilot's first value A is sampled as every pixel is, its second value B by other random numbers. ``(A - B)² / 2`` has the
# mean of A's variance, whatever sampler made them. relMSE divides it by ``r² + 0.01`` with the true radiance r; the median of
# A, B and the mean of the eight pixels around stands for it.
#
# Where few pixels carry the error (caustics, edges of bright lights) pilots say little: they meet few such pixels or none, and
# two values do not tell r. So some pixels are looked at again, by several more streams that are no part of the picture:
#
# - *suspects*: the pixels that stand out most from their second brightest neighbour, wherever they are. Of each the error that
#   the picture really has is then known, so what sparkles in the picture is counted and not guessed.
# - *doubtful pilots*: those whose two values differ most, for the r that theirs is divided by.
#
# The interval is that of the mean over pilots, symmetric in its logarithm, as errors are squares and lean to the right. It is
# called heavy-tailed, and is not to be trusted, where suspects have most of the error, where the standard error is half of the
# estimate, or where the largest errors of pilots have a tail too heavy for a mean (:mod:`torchpt.physics.film.error`).


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
class ErrorEstimate:
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


def probe_estimate(pilots: Pilots, a: Tensor, b: Tensor, spare: Tensor | None, counted: bool) -> ErrorEstimate:
    """By the pilots alone, so that no other pixel has a say: the relMSE that decisions are made by."""
    share = error_by_pilots(pilots, a, b) * _first_part(a, b, spare)
    pixels = float(sum_all(pilots.weight))
    part = 1.0 - 0.5 * len(pilots) / pixels if counted else 1.0
    mean = float(sum_all(share * pilots.weight)) / pixels
    parts = pilots.weight / pixels * (share - mean) * part
    return _estimate(mean * part, parts, 0.0, False, share)


@dataclass(frozen=True)
class Resampled:
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


def resample_counts(pixels: int, pilots: int) -> tuple[int, int]:
    """Return how many suspects and how many doubtful pilots are looked at again, at most."""
    return max(pixels // SUSPECTS, 1), max(pilots // DOUBTFUL, 4)


def pixels_to_resample(picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
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
    count = min(resample_counts(len(rest), len(pilots))[1], int(rest.sum()))
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
    standing = _excess(picture.reshape(-1, picture.shape[2])[few], _neighbours(picture, few))
    count, _ = resample_counts(bright.numel(), 0)
    return few[standing.topk(min(count, len(few))).indices].sort().values


def error_estimate(
    picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor, spare: Tensor | None, counted: bool, again: Resampled | None
) -> ErrorEstimate | None:
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
        sure, unsure = _actual_error(flat[suspects], again.mean[: again.suspects], again.spare[: again.suspects])
        rest = ~torch.isin(places, suspects)
        # A second value that would be a suspect itself tells of others like it, which are counted already.
        least = _excess(flat[suspects], _neighbours(picture, suspects)).min() if len(suspects) else math.inf
        b = torch.where((_excess(b, others) > least)[:, None], near, b)
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
    return _estimate(total, parts, unsure / pixels**2, sure / pixels > FEW * total, share)


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


def _excess(values: Tensor, others: Tensor) -> Tensor:
    """By how much ``values (n, C)`` exceed the second brightest of ``others (8, n, C)``, relative to their mean ``(n,)``."""
    second = others.topk(2, 0).values[1]
    return relative((values - second).clamp_min(0.0).square(), others.mean(0)).mean(1)


def _actual_error(values: Tensor, mean: Tensor, spare: Tensor) -> tuple[float, float]:
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


def _estimate(mean: float, parts: Tensor, unsure: float, few: bool, share: Tensor) -> ErrorEstimate:
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
        return ErrorEstimate(mean, (0.0, 0.0) if mean == 0.0 and count >= FEWEST else None, not math.isfinite(mean))
    if count < FEWEST:
        return ErrorEstimate(mean, None, True)
    deviation = math.sqrt(float(sum_all(parts.square())) + unsure)
    heavy = few or deviation > VAGUE * mean or (count >= MIN_TAIL_VALUES and heavy_tail(share))
    factor = math.exp(min(_quantile(count - 1) * deviation / mean, 300.0))
    return ErrorEstimate(mean, (mean / factor, mean * factor), heavy)


def _quantile(freedom: int) -> float:
    """Student's t at 97.5 % (Abramowitz and Stegun 26.7.5, to the second term)."""
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)


# ---- How adaptive sampling shares samples out: more for blocks of pixels whose error falls most by them
#
# A pixel of n samples whose relative variance is ``e`` has ``s = sqrt(e n)`` a sample; for so many samples in all the sum of
# ``s² / n`` over pixels is least where n goes with s. What ``e`` is, pilots say, one a block (:func:`expected_errors`).
# Other pixels are not asked, so none of them owes its number of samples to its own value. Numbers are powers of two times the
# first one, as Sobol' points are at their best there.


#: No block of pixels takes more than this many times its samples at once: it is known by few pilots.
GROWTH = 4
#: Errors below this part of the mean count as much: what no pilot has met yet may be there all the same.
FLOOR = 0.05
#: Errors up to this quantile are taken as what pilots around have, too.
ORDINARY = 0.95


def expected_errors(errors: Tensor, known: Tensor) -> Tensor:
    """What blocks are expected to have of an error ``(R, C)`` that single pilots tell, where blocks are ``known (R, C)``.

    Most pilots tell of the noise around them. The few large ones may be an edge, or rare samples that are as likely elsewhere:
    where they gathered by chance, samples would be taken from where the next ones will be. So what errors have above the 95th
    percentile is believed only as far as the pilots around foretell it, by regression; the rest of it all blocks share. Where
    no block is known nothing is expected of any.
    """
    if not bool(known.any()):
        return torch.zeros_like(errors)
    body = torch.minimum(errors, errors[known].quantile(ORDINARY))
    tail = torch.where(known, errors - body, 0.0)
    mean = sum_all(tail) / sum_all(known.double())
    told = _smoothed(tail, known, own=False) - mean
    apart = torch.where(known, told, 0.0)
    below = float(sum_all(apart.square()))
    trust = min(max(float(sum_all(apart * (tail - mean))) / below, 0.0), 1.0) if below > 0.0 else 0.0
    return _smoothed(body, known) + mean + trust * (_smoothed(tail, known) - mean)


def _smoothed(values: Tensor, known: Tensor, own: bool = True) -> Tensor:
    """Means ``(R, C)`` over 5 x 5 blocks with binomial weights, of the blocks that are ``known``; the mean of all elsewhere.

    Without ``own`` a block has no part in its own mean.
    """
    kernel = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=values.dtype)

    def spread(x: Tensor) -> Tensor:
        for axis in (0, 1):
            wide = torch.nn.functional.pad(x, (2, 2, 0, 0) if axis else (0, 0, 2, 2))
            size = x.shape[axis]
            parts = [kernel[k] * wide.narrow(axis, k, size) for k in range(5)]
            x = parts[0] + parts[1] + parts[2] + parts[3] + parts[4]
        return x

    there = known.to(values.dtype)
    weight, total = spread(there), spread(values * there)
    if not own:
        centre = kernel[2].square() * there
        weight, total = weight - centre, total - centre * values
    mean = sum_all(values * there) / sum_all(there).clamp_min(1.0)
    return torch.where(weight > 0, total / weight.clamp_min(1e-30), mean)


def allocate_samples(error: Tensor, counts: Tensor, pixels: Tensor, mean: float, last: bool = False) -> Tensor:
    """Samples a pixel that blocks are to have ``(B,)`` int64: those they have, twice or four times as many.

    In the ``last`` round what cannot double any more is filled up by halves, quarters, ... of what blocks have, so that less is
    left over than a sample of the smallest block's pixels.

    Args:
        error: relative variance of the pixels of each block ``(B,)`` float64, at its present number of samples.
        counts: that number ``(B,)`` int64.
        pixels: of each block ``(B,)``.
        mean: samples a pixel over the picture that there are to be, at most.
        last: whether no round follows.
    """
    positive = error.clamp_min(0.0)
    floor = FLOOR * sum_all(positive * pixels) / sum_all(pixels.double())
    need = (positive.clamp_min(floor) * counts).sqrt()
    have, most = counts.double(), (GROWTH * counts).double()
    total = mean * float(sum_all(pixels.double()))
    if not bool((need > 0).any()):
        need = torch.ones_like(need)
    low, high = 0.0, float((most / need.clamp_min(1e-30)).max())
    for _ in range(60):  # the number of samples a unit of need at which they come to the total
        middle = 0.5 * (low + high)
        if float(sum_all(torch.minimum(torch.maximum(have, middle * need), most) * pixels)) < total:
            low = middle
        else:
            high = middle
    wanted = torch.minimum(torch.maximum(have, low * need), most) / have
    doubled = wanted.log2().add(1e-9).floor().clamp(0, 2).long()
    aims = counts << doubled
    # What is left goes to those that are furthest below what they want, as far as it reaches.
    order = (wanted / (1 << doubled)).argsort(descending=True, stable=True)
    order = order[doubled[order] < 2]
    spent = ((aims * pixels)[order]).cumsum(0)
    left = total - float((aims * pixels).sum())
    aims[order[spent <= left]] *= 2
    return _filled_up(aims, wanted * have, pixels, total) if last else aims


def _filled_up(aims: Tensor, wanted: Tensor, pixels: Tensor, total: float) -> Tensor:
    """Numbers of samples ``(B,)`` that come to ``total`` over all pixels, as nearly as whole samples of blocks do.

    Args:
        aims: to begin with.
        wanted: what blocks would have if that need not be whole: those that are furthest below it come first.
        pixels: of each block.
        total: samples in all.
    """
    order, halvings = (wanted / aims).argsort(descending=True, stable=True), 0
    while True:
        halvings += 1
        more = (aims >> halvings).clamp_min(1)
        spent = (more * pixels)[order].cumsum(0)
        fits = order[spent <= total - float((aims * pixels).sum())]
        aims[fits] += more[fits]
        if not len(fits) and int(more.max()) == 1:
            return aims
