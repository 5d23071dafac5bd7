"""Error estimates of pictures by error probes, their confidence intervals, and sample allocation for adaptive sampling."""

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


# ---- Heavy tails: whether a sample mean can be trusted
#
# A generalized Pareto distribution of shape k is fitted to the largest values. Its moments of order below 1 / k exist: it has
# no variance for k >= 1/2 and no mean for k >= 1. The fit is that of Zhang and Stephens (2009), *A New and Efficient Estimation
# Method for the Generalized Pareto Distribution*, Technometrics 51(3). The length of the tail, the weak prior and the threshold
# are those of Vehtari, Simpson, Gelman, Yao and Gabry (2024), *Pareto Smoothed Importance Sampling*, JMLR 25(72).


#: Least number of values for :func:`heavy_tail`.
MIN_TAIL_VALUES = 25
#: Weight of the prior of the shape, and its mean.
_PRIOR, _EXPECTED = 10.0, 0.5


def heavy_tail(values: Tensor) -> bool:
    """Return True if the upper tail of ``values (n,)`` is too heavy for their mean to be trusted; n >= ``MIN_TAIL_VALUES``.

    The shape has to exceed the threshold by two standard errors ``(1 + k) / sqrt(m)`` of a fit to m values.
    """
    ordered = np.sort(values.detach().cpu().double().numpy())
    count = int(min(0.2 * len(ordered), 3.0 * math.sqrt(len(ordered))))
    excess = ordered[-count:] - ordered[-count - 1]
    if not excess[-1] > 0.0:
        return False
    # The logarithm of 0 does not exist; values this small have no weight.
    shape = _fitted(np.maximum(excess, 1e-30 * excess[-1]))
    shape = (count * shape + _PRIOR * _EXPECTED) / (count + _PRIOR)
    least = shape - 2.0 * (1.0 + abs(shape)) / math.sqrt(count + _PRIOR)
    return least > min(1.0 - 1.0 / math.log10(len(ordered)), 0.7)


def _fitted(x: NDArray[np.float64]) -> float:
    """Return the posterior mean of the shape of a generalized Pareto distribution, from ``x (n,)``, positive and ascending."""
    n = len(x)
    m = 30 + math.isqrt(n)
    quartile = x[int(n / 4 + 0.5) - 1]
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)
    k = np.log1p(-theta[:, None] * x).mean(1)
    likelihood = n * (np.log(-theta / k) - k - 1.0)
    weight = 1.0 / np.exp(np.minimum(likelihood - likelihood[:, None], 700.0)).sum(1)
    mean = float((theta * weight).sum() / weight.sum())
    return float(np.log1p(-mean * x).mean())


# ---- Error probes (pilots): one pixel of each block of 4 x 4 is sampled a second time, with other random numbers
#
# The difference of two independent values of a pixel tells its error, for any sampler. The positions of pilots depend on the
# seed and on the whole film alone: a crop has the same pilots.


#: Side of a block in pixels.
BLOCK = 4
_NAME = 0x50494C4F


@dataclass(frozen=True)
class Pilots:
    """The n error probes of a picture, one for each block whose probe lies in the picture.

    Attributes:
        places: pixel indices ``(n,)`` int64, ascending by block.
        weight: number of pixels of each block ``(n,)`` float64.
        block: row and column of each block ``(2, n)`` int64.
        blocks: number of rows and columns of blocks that overlap the picture.
        corner: position ``(x, y)`` of the picture's corner in its first block, in pixels.
    """

    places: Tensor
    weight: Tensor
    block: Tensor
    blocks: tuple[int, int]
    corner: tuple[int, int]

    def __len__(self) -> int:
        return len(self.places)


def pilots_of(seed: int, film: tuple[int, int], crop: tuple[int, int, int, int]) -> Pilots:
    """Return the error probes of a crop ``(x, y, width, height)`` of a film ``(width, height)``."""
    x0, y0, width, height = crop
    first = x0 // BLOCK, y0 // BLOCK
    columns, rows = -(-(x0 + width) // BLOCK) - first[0], -(-(y0 + height) // BLOCK) - first[1]
    row, column = (
        grid.reshape(-1)
        for grid in torch.meshgrid(torch.arange(rows) + first[1], torch.arange(columns) + first[0], indexing="ij")
    )
    # Blocks at the film's edge have fewer pixels.
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


# ---- The error estimate, from error probes with two independent values
#
# The first value A of a pilot is sampled like every pixel, the second value B with other random numbers. The expectation of
# ``(A - B)² / 2`` is the variance of A, for any sampler. relMSE divides it by ``r² + 0.01`` with the true radiance r, which is
# estimated by the median of A, B and the mean of the eight neighbours.
#
# Where few pixels carry the error (caustics, edges of bright lights) pilots miss most of them, and two values do not estimate
# r. So some pixels are resampled by several more randomizations, which do not count for the picture:
#
# - *suspects*: the pixels that exceed their second brightest neighbour most. Their actual errors are then known, so fireflies
#   are counted, not estimated.
# - *doubtful pilots*: the pilots whose two values differ most, for a better r.
#
# The interval is that of the mean over pilots, symmetric in the logarithm, as squared errors are skewed. It is called
# heavy-tailed, and cannot be trusted, if suspects have most of the error, if the standard error is more than half of the
# estimate, or if the errors of pilots have a heavy tail (:func:`heavy_tail`).


#: Least number of pilots for an interval.
FEWEST = 8
#: The interval is heavy-tailed if suspects have more than this fraction of the error, or if its standard error is larger.
FEW, VAGUE = 0.5, 0.5
#: One of this many pixels is a suspect, one of this many pilots is doubtful.
SUSPECTS, DOUBTFUL = 1024, 64
#: Number of randomizations that resample them.
STREAMS = 8
#: The new values may all miss a light that few samples hit: r is at least one over this factor of a pilot's mean, or of a
#: suspect's value.
BRIGHTER, BRIGHTEST = 4.0, 32.0


@dataclass(frozen=True)
class ErrorEstimate:
    """An estimate of relMSE, the mean of ``(x - r)² / (r² + 0.01)`` over pixels and channels.

    Attributes:
        relmse: estimated relMSE of the picture.
        interval: 95 % confidence interval; None for fewer than ``FEWEST`` pilots.
        heavy_tailed: whether so few pixels carry the error that the interval cannot be trusted.
    """

    relmse: float
    interval: tuple[float, float] | None
    heavy_tailed: bool


def around(values: Tensor, known: Tensor) -> Tensor:
    """Return the mean over the ``known (H, W)`` ones of the eight neighbours of each element of ``values (H, W, C)``.

    An element without known neighbours keeps its own value.
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
    """Return the squared error of each pilot's first value ``(n, C)`` over ``r² + 0.01``, estimated from two values.

    Args:
        a: first values ``(n, C)``.
        b: second values ``(n, C)``.
        near: means of the neighbours ``(n, C)``.
    """
    radiance = torch.stack((a, b, near)).median(0).values
    return relative((a - b).square() / 2, radiance)


def error_by_pilots(pilots: Pilots, a: Tensor, b: Tensor) -> Tensor:
    """Return :func:`error_at` with neighbouring pilots as neighbours, averaged over channels ``(n,)``."""
    grid = a.new_zeros(*pilots.blocks, a.shape[1])
    known = torch.zeros(pilots.blocks, dtype=torch.bool)
    at = tuple(pilots.block)
    grid[at], known[at] = (a + b) / 2, True
    return error_at(a, b, around(grid, known)[at]).mean(1)


def probe_estimate(pilots: Pilots, a: Tensor, b: Tensor, spare: Tensor | None, counted: bool) -> ErrorEstimate:
    """Return the estimate from pilots alone, independent of all other pixels: stop rules use it."""
    share = error_by_pilots(pilots, a, b) * _first_part(a, b, spare)
    pixels = float(sum_all(pilots.weight))
    part = 1.0 - 0.5 * len(pilots) / pixels if counted else 1.0
    mean = float(sum_all(share * pilots.weight)) / pixels
    parts = pilots.weight / pixels * (share - mean) * part
    return _estimate(mean * part, parts, 0.0, False, share)


@dataclass(frozen=True)
class Resampled:
    """Resampled pixels: suspects and doubtful pilots.

    Attributes:
        places: pixel indices ``(m,)`` int64; suspects first, then pilots in their order.
        suspects: number of suspects; the others are pilots.
        mean: mean of the new values ``(m, C)``.
        spare: variance of ``mean`` ``(m, C)``.
    """

    places: Tensor
    suspects: int
    mean: Tensor
    spare: Tensor


def resample_counts(pixels: int, pilots: int) -> tuple[int, int]:
    """Return the largest numbers of suspects and of doubtful pilots to resample."""
    return max(pixels // SUSPECTS, 1), max(pilots // DOUBTFUL, 4)


def pixels_to_resample(picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of pixels to resample: suspects and doubtful pilots, each ``(m,)``.

    Args:
        picture: ``(H, W, C)`` float64.
        pilots: the n pilots.
        a: first values ``(n, C)``.
        b: second values ``(n, C)``.
    """
    suspects = _suspects(picture)
    rest = ~torch.isin(pilots.places, suspects)
    low = torch.minimum(a, b).clamp_min(0.0)
    doubt = relative((a - b).square(), low).mean(1) * rest
    count = min(resample_counts(len(rest), len(pilots))[1], int(rest.sum()))
    return suspects, pilots.places[doubt.topk(count).indices.sort().values]


def _suspects(picture: Tensor) -> Tensor:
    """Return the pixels that stand out most, among those brighter than at least seven of their neighbours."""
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
    """Return the error estimate of a picture.

    Args:
        picture: ``(H, W, C)`` float64, on the CPU.
        pilots: the n pilots.
        a: first values ``(n, C)``.
        b: second values ``(n, C)``.
        spare: estimated variance of ``b`` ``(n, C)`` if it differs from that of ``a``, else None.
        counted: whether second values are part of the picture, as half of each pilot.
        again: the resampled pixels; None before resampling.

    Returns:
        The estimate; None without pilots.
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
        # A second value that would be a suspect itself stands for other suspects, which are counted already.
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
    """Return twice the fraction of first values in the variance of differences; 1 if both values have the same variance.

    Second values made of two randomizations of half the length vary more, as the error of Sobol' points falls faster than that
    of random ones. The ratio is estimated over all pilots and clamped.
    """
    if spare is None:
        return 1.0
    scale = relative(1.0, (a + b) / 2)
    both, second = (float(sum_all((x * scale).clamp_max(1.0))) for x in ((a - b).square(), spare))
    return 2.0 * min(max(1.0 - second / both, 1 / 3), 0.5) if both > 0.0 else 1.0


def _neighbours(picture: Tensor, places: Tensor) -> Tensor:
    """Return the eight neighbours ``(8, n, C)`` of pixels, with the nearest pixel beyond the edge."""
    height, width, channels = picture.shape
    x, y = places % width, torch.div(places, width, rounding_mode="floor")
    steps = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy]
    at = [(y + dy).clamp(0, height - 1) * width + (x + dx).clamp(0, width - 1) for dx, dy in steps]
    return picture.reshape(-1, channels)[torch.stack(at)]


def _excess(values: Tensor, others: Tensor) -> Tensor:
    """Return the relative squared excess ``(n,)`` of ``values (n, C)`` over the second brightest of ``others (8, n, C)``."""
    second = others.topk(2, 0).values[1]
    return relative((values - second).clamp_min(0.0).square(), others.mean(0)).mean(1)


def _actual_error(values: Tensor, mean: Tensor, spare: Tensor) -> tuple[float, float]:
    """Return the summed squared error of resampled pixels over ``r² + 0.01``, and its variance.

    Args:
        values: values of the picture ``(m, C)``.
        mean: mean of the new values ``(m, C)``.
        spare: variance of ``mean`` ``(m, C)``.
    """
    radiance, apart = torch.maximum(mean.abs(), values.abs() / BRIGHTEST), values - mean
    share = relative(apart.square() - spare, radiance)
    # To first order in the mean. Channels are correlated, so their standard deviations are added.
    slope = relative(2 * apart.abs() + 2 * radiance * share.abs(), radiance)
    return float(sum_all(share.mean(1))), float(sum_all((slope * spare.sqrt()).mean(1).square()))


def _estimate(mean: float, parts: Tensor, unsure: float, few: bool, share: Tensor) -> ErrorEstimate:
    """Return the estimate with its interval.

    Args:
        mean: the estimate.
        parts: deviations of the pilots; the sum of their squares is the variance of the mean.
        unsure: variance due to suspects.
        few: whether suspects have most of the error.
        share: errors of the pilots.
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
    """Return the 97.5 % quantile of Student's t (Abramowitz and Stegun 26.7.5, to the second term)."""
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)


# ---- Sample allocation for adaptive sampling, by blocks of pixels
#
# A pixel of n samples and relative variance ``e`` has the standard deviation ``s = sqrt(e n)`` a sample. For a given total the
# sum of ``s² / n`` over pixels is least for n in proportion to s. Pilots estimate ``e``, one a block: :func:`expected_errors`.
# Other pixels are not used, so that no pixel's number of samples depends on its own value, which would bias it. Numbers are
# powers of two times the first one, the best for Sobol' points.


#: Largest growth of the samples of a block in one round, as few pilots estimate its error.
GROWTH = 4
#: Errors count as at least this fraction of the mean, as pilots may have missed rare contributions.
FLOOR = 0.05
#: Errors up to this quantile are smoothed over neighbouring blocks as they are.
ORDINARY = 0.95


def expected_errors(errors: Tensor, known: Tensor) -> Tensor:
    """Return the expected error of each block ``(R, C)``, from the errors of single pilots in blocks that are ``known (R, C)``.

    Most pilots tell the noise of their neighbourhood. A few large errors may be due to an edge, or to rare samples that are as
    likely elsewhere: following these would take samples from where the next ones will occur. So the part of errors above the
    95th percentile is used only as far as neighbouring pilots predict it, by regression; the rest is spread over all blocks.
    Without known blocks the result is 0.
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
    """Return means ``(R, C)`` of known blocks over 5 x 5 neighbourhoods with binomial weights; the overall mean elsewhere.

    Without ``own`` a block is left out of its own mean.
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
    """Return new numbers of samples a pixel of each block ``(B,)`` int64: the present ones times 1, 2 or 4.

    In the ``last`` round the remaining samples are given out as halves, quarters, ... of present numbers, until they do not
    suffice for one more sample of the pixels of any block.

    Args:
        error: relative variance of the pixels of each block ``(B,)`` float64, at its present number of samples.
        counts: present numbers of samples a pixel ``(B,)`` int64.
        pixels: number of pixels of each block ``(B,)``.
        mean: largest mean number of samples a pixel over the picture.
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
    for _ in range(60):  # bisect the samples per unit of need for the total
        middle = 0.5 * (low + high)
        if float(sum_all(torch.minimum(torch.maximum(have, middle * need), most) * pixels)) < total:
            low = middle
        else:
            high = middle
    wanted = torch.minimum(torch.maximum(have, low * need), most) / have
    doubled = wanted.log2().add(1e-9).floor().clamp(0, 2).long()
    aims = counts << doubled
    # Remaining samples go to the blocks that are furthest below the wanted numbers.
    order = (wanted / (1 << doubled)).argsort(descending=True, stable=True)
    order = order[doubled[order] < 2]
    spent = ((aims * pixels)[order]).cumsum(0)
    left = total - float((aims * pixels).sum())
    aims[order[spent <= left]] *= 2
    return _filled_up(aims, wanted * have, pixels, total) if last else aims


def _filled_up(aims: Tensor, wanted: Tensor, pixels: Tensor, total: float) -> Tensor:
    """Return numbers of samples ``(B,)`` whose total over all pixels comes as near to ``total`` as possible from below.

    Args:
        aims: numbers to start with ``(B,)``.
        wanted: ideal, fractional numbers ``(B,)``: blocks furthest below them come first.
        pixels: number of pixels of each block ``(B,)``.
        total: total number of samples.
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
