"""Error estimates of pictures by error probes, their confidence intervals, and sample allocation for adaptive sampling.

The functions are pure statistics of tensors on the CPU, in float64; :mod:`torchpt.rendering.error` samples what they need.
Error probes (scene key ``render.pilots``, hence *pilots* in names) are pixels with two independent values each. The error is
measured as relMSE, the mean of ``(x - r)² / (r² + 0.01)`` over pixels and channels with the true radiance r;
:func:`torchpt.images.metrics.relative` divides a squared error by that denominator.
"""

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
    "RESAMPLING_RANDOMIZATIONS",
    "ErrorEstimate",
    "Pilots",
    "Resampled",
    "allocate_samples",
    "error_at",
    "error_by_pilots",
    "error_estimate",
    "expected_errors",
    "is_heavy_tailed",
    "mean_of_neighbours",
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


#: Least number of values for :func:`is_heavy_tailed`.
MIN_TAIL_VALUES = 25
#: Weight of the prior of the shape in values, and its mean (those of Vehtari et al.).
_PRIOR_WEIGHT, _PRIOR_MEAN = 10.0, 0.5


def is_heavy_tailed(values: Tensor) -> bool:
    """Return True if the upper tail of ``values (n,)`` is too heavy for their mean to be trusted; n >= ``MIN_TAIL_VALUES``.

    The shape has to exceed the threshold ``min(1 - 1 / log10(n), 0.7)`` by two standard errors ``(1 + k) / sqrt(m)`` of a fit
    to the m largest values, ``m = min(n / 5, 3 sqrt(n))``.
    """
    ordered = np.sort(values.detach().cpu().double().numpy())
    count = int(min(0.2 * len(ordered), 3.0 * math.sqrt(len(ordered))))
    excess = ordered[-count:] - ordered[-count - 1]  # over the largest value below the tail
    if not excess[-1] > 0.0:
        return False
    # The logarithm of 0 does not exist; values this small have no weight.
    shape = _pareto_shape(np.maximum(excess, 1e-30 * excess[-1]))
    shape = (count * shape + _PRIOR_WEIGHT * _PRIOR_MEAN) / (count + _PRIOR_WEIGHT)
    lower_bound = shape - 2.0 * (1.0 + abs(shape)) / math.sqrt(count + _PRIOR_WEIGHT)
    return lower_bound > min(1.0 - 1.0 / math.log10(len(ordered)), 0.7)


def _pareto_shape(x: NDArray[np.float64]) -> float:
    """Return the posterior mean of the shape of a generalized Pareto distribution, from ``x (n,)``, positive and ascending.

    Zhang and Stephens 2009, in their notation: theta is the ratio of shape and scale, of which m candidates are weighted by
    their profile likelihood.
    """
    n = len(x)
    m = 30 + math.isqrt(n)
    quartile = x[int(n / 4 + 0.5) - 1]
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(m / (np.arange(1, m + 1) - 0.5))) / (3.0 * quartile)  # (m,)
    k = np.log1p(-theta[:, None] * x).mean(1)  # (m,) the shape that is likeliest for each theta
    log_likelihood = n * (np.log(-theta / k) - k - 1.0)
    # exp(710) overflows: a candidate this much less likely has no weight.
    weight = 1.0 / np.exp(np.minimum(log_likelihood - log_likelihood[:, None], 700.0)).sum(1)
    mean_theta = float((theta * weight).sum() / weight.sum())
    return float(np.log1p(-mean_theta * x).mean())


# ---- Error probes (pilots): one pixel of each block of 4 x 4 is sampled a second time, with other random numbers
#
# The difference of two independent values of a pixel tells its error, for any sampler. The positions of pilots depend on the
# seed and on the whole film alone: a crop has the same pilots. Blocks are counted from the corner of the whole film.


#: Side of a block in pixels.
BLOCK = 4
#: Mixed into the seed, so that positions of pilots are independent of the samples: "PILO" in ASCII.
_PILOT_SALT = 0x50494C4F


@dataclass(frozen=True)
class Pilots:
    """The n error probes of a picture, one for each block whose probe lies in the picture.

    Attributes:
        pixels: index of each probe's pixel in the picture, row by row ``(n,)`` int64, ascending by block.
        pixels_of_block: number of pixels of each probe's block ``(n,)`` float64.
        block: row and column of each probe's block, from 0 in the picture ``(2, n)`` int64.
        blocks: number of rows and columns of blocks that overlap the picture.
        corner: position ``(x, y)`` of the picture's corner in its first block, in pixels.
    """

    pixels: Tensor
    pixels_of_block: Tensor
    block: Tensor
    blocks: tuple[int, int]
    corner: tuple[int, int]

    def __len__(self) -> int:
        return len(self.pixels)


def pilots_of(seed: int, film: tuple[int, int], crop: tuple[int, int, int, int]) -> Pilots:
    """Return the error probes of a crop ``(x, y, width, height)`` of a film ``(width, height)``."""
    x0, y0, width, height = crop
    film_width, film_height = film
    first_column, first_row = x0 // BLOCK, y0 // BLOCK
    # -(-a // b) is a / b rounded up.
    columns, rows = -(-(x0 + width) // BLOCK) - first_column, -(-(y0 + height) // BLOCK) - first_row
    row, column = (
        grid.reshape(-1)
        for grid in torch.meshgrid(torch.arange(rows) + first_row, torch.arange(columns) + first_column, indexing="ij")
    )
    # Blocks at the film's edge have fewer pixels.
    wide, high = (film_width - BLOCK * column).clamp_max(BLOCK), (film_height - BLOCK * row).clamp_max(BLOCK)
    number = (row * -(-film_width // BLOCK) + column).to(torch.int32)  # of the block on the whole film
    salted_seed = as_int32(mix_int(mix_int(seed) ^ as_int32(seed >> 32)) ^ _PILOT_SALT)
    drawn = (
        to_unit(mix(mix(number) ^ salted_seed)).double() * wide * high
    ).long()  # pixel within the block, row by row
    x, y = BLOCK * column + drawn % wide - x0, BLOCK * row + torch.div(drawn, wide, rounding_mode="floor") - y0
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    return Pilots(
        pixels=(y * width + x)[inside],
        pixels_of_block=(wide * high)[inside].double(),
        block=torch.stack((row - first_row, column - first_column))[:, inside],
        blocks=(rows, columns),
        corner=(x0 - BLOCK * first_column, y0 - BLOCK * first_row),
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
# estimate, or if the errors of pilots have a heavy tail (:func:`is_heavy_tailed`).


#: Least number of pilots for an interval.
MIN_PILOTS = 8
#: The interval is heavy-tailed if suspects have more than the first fraction of the error, or if its standard error is more
#: than the second fraction of the estimate.
MAX_SUSPECT_FRACTION, MAX_STANDARD_ERROR = 0.5, 0.5
#: One of this many pixels is a suspect, one of this many pilots is doubtful: resampling them takes little time.
PIXELS_PER_SUSPECT, PILOTS_PER_DOUBTFUL = 1024, 64
#: Number of randomizations that resample them.
RESAMPLING_RANDOMIZATIONS = 8
#: The new values may all miss a light that few samples hit: r is at least one over this factor of a pilot's mean, or of a
#: suspect's value.
MAX_PILOT_RATIO, MAX_SUSPECT_RATIO = 4.0, 32.0


@dataclass(frozen=True)
class ErrorEstimate:
    """An estimate of the relMSE of a picture.

    Attributes:
        relmse: the estimate.
        interval: 95 % confidence interval (low, high); None for fewer than ``MIN_PILOTS`` pilots.
        heavy_tailed: whether so few pixels carry the error that the interval cannot be trusted.
    """

    relmse: float
    interval: tuple[float, float] | None
    heavy_tailed: bool


def mean_of_neighbours(values: Tensor, known: Tensor) -> Tensor:
    """Return for each element of a grid the mean of those of its eight neighbours that are known ``(R, S, C)``.

    An element without known neighbours keeps its own value.

    Args:
        values: the grid, R rows and S columns ``(R, S, C)``.
        known: True where it has a value ``(R, S)`` bool.
    """
    rows, columns, _ = values.shape
    weight = known.to(values.dtype)
    total, count = torch.zeros_like(values), torch.zeros_like(weight)
    padded = torch.nn.functional.pad((values * weight[..., None]), (0, 0, 1, 1, 1, 1))
    padded_weight = torch.nn.functional.pad(weight, (1, 1, 1, 1))
    for dy in range(3):
        for dx in range(3):
            if (dx, dy) != (1, 1):  # the element itself
                total += padded[dy : dy + rows, dx : dx + columns]
                count += padded_weight[dy : dy + rows, dx : dx + columns]
    return torch.where(count[..., None] > 0, total / count.clamp_min(1.0)[..., None], values)


def error_at(a: Tensor, b: Tensor, near: Tensor) -> Tensor:
    """Return the squared error of each pilot's first value over ``r² + 0.01``, estimated from two values ``(n, C)``.

    Args:
        a: first values of the pilots ``(n, C)``.
        b: second values ``(n, C)``.
        near: means of the neighbours ``(n, C)``.
    """
    radiance = torch.stack((a, b, near)).median(0).values
    return relative((a - b).square() / 2, radiance)


def error_by_pilots(pilots: Pilots, a: Tensor, b: Tensor) -> Tensor:
    """Return the relative squared error of each pilot's first value, averaged over channels ``(n,)``.

    The neighbours that help to estimate r are the pilots of neighbouring blocks: no other pixel has any influence.

    Args:
        pilots: the n pilots.
        a: first values ``(n, C)``.
        b: second values ``(n, C)``.
    """
    grid = a.new_zeros(*pilots.blocks, a.shape[1])
    known = torch.zeros(pilots.blocks, dtype=torch.bool)
    at = tuple(pilots.block)
    grid[at], known[at] = (a + b) / 2, True
    return error_at(a, b, mean_of_neighbours(grid, known)[at]).mean(1)


def probe_estimate(
    pilots: Pilots, a: Tensor, b: Tensor, b_variance: Tensor | None, *, b_counted: bool
) -> ErrorEstimate:
    """Return the estimate from pilots alone, independent of all other pixels: stop rules use it.

    Arguments as for :func:`error_estimate`.
    """
    errors = error_by_pilots(pilots, a, b) * _first_value_factor(a, b, b_variance)
    pixels = float(sum_all(pilots.pixels_of_block))
    # The mean of both values of a pilot has half the error of one.
    scale = 1.0 - 0.5 * len(pilots) / pixels if b_counted else 1.0
    mean = float(sum_all(errors * pilots.pixels_of_block)) / pixels
    deviations = pilots.pixels_of_block / pixels * (errors - mean) * scale
    return _estimate(mean * scale, deviations, suspects_variance=0.0, mostly_suspects=False, errors=errors)


@dataclass(frozen=True)
class Resampled:
    """The m resampled pixels: suspects and doubtful pilots.

    Attributes:
        pixels: pixel indices ``(m,)`` int64; suspects first, then pilots in their order.
        suspects: number of suspects; the others are pilots.
        mean: mean of the new values ``(m, C)``.
        variance: variance of ``mean`` ``(m, C)``.
    """

    pixels: Tensor
    suspects: int
    mean: Tensor
    variance: Tensor


def resample_counts(pixels: int, pilots: int) -> tuple[int, int]:
    """Return the largest numbers of suspects and of doubtful pilots to resample, for numbers of pixels and of pilots."""
    return max(pixels // PIXELS_PER_SUSPECT, 1), max(pilots // PILOTS_PER_DOUBTFUL, 4)


def pixels_to_resample(picture: Tensor, pilots: Pilots, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices of pixels to resample: suspects, and doubtful pilots that are no suspects ``(m,)`` int64 each.

    Args:
        picture: ``(H, W, C)`` float64.
        pilots: the n pilots.
        a: first values ``(n, C)``.
        b: second values ``(n, C)``.
    """
    suspects = _suspects(picture)
    is_candidate = ~torch.isin(pilots.pixels, suspects)
    low = torch.minimum(a, b).clamp_min(0.0)
    doubt = relative((a - b).square(), low).mean(1) * is_candidate
    _, most_doubtful = resample_counts(picture.shape[0] * picture.shape[1], len(pilots))
    count = min(most_doubtful, int(is_candidate.sum()))
    return suspects, pilots.pixels[doubt.topk(count).indices.sort().values]


def _suspects(picture: Tensor) -> Tensor:
    """Return the pixels ``(m,)`` int64 that exceed their neighbours most, among those with at most one brighter neighbour."""
    brightness = picture.sum(2)
    padded = torch.nn.functional.pad(brightness, (1, 1, 1, 1), value=-math.inf)
    height, width = brightness.shape
    brighter_neighbours = torch.zeros(height, width, dtype=torch.int8)
    for dy in range(3):
        for dx in range(3):
            brighter_neighbours += padded[dy : dy + height, dx : dx + width] > brightness
    candidates = (brighter_neighbours.reshape(-1) <= 1).nonzero()[:, 0]
    excess = _excess(picture.reshape(-1, picture.shape[2])[candidates], _neighbours(picture, candidates))
    most_suspects, _ = resample_counts(brightness.numel(), 0)
    return candidates[excess.topk(min(most_suspects, len(candidates))).indices].sort().values


def error_estimate(
    picture: Tensor,
    pilots: Pilots,
    a: Tensor,
    b: Tensor,
    b_variance: Tensor | None,
    *,
    b_counted: bool,
    resampled: Resampled | None,
) -> ErrorEstimate | None:
    """Return the error estimate of a picture.

    Args:
        picture: ``(H, W, C)`` float64, on the CPU.
        pilots: the n pilots.
        a: their first values ``(n, C)``.
        b: their second values ``(n, C)``.
        b_variance: estimated variance of ``b`` ``(n, C)`` if it differs from that of ``a``, else None.
        b_counted: whether second values are part of the picture, as half of each pilot.
        resampled: the resampled pixels; None before resampling.

    Returns:
        The estimate; None without pilots.
    """
    if not len(pilots):
        return None
    values = picture.reshape(-1, picture.shape[2])  # (pixels, C)
    neighbours = _neighbours(picture, pilots.pixels)
    near = neighbours.mean(0)
    factor = _first_value_factor(a, b, b_variance)
    suspects, suspects_error, suspects_variance = pilots.pixels[:0], 0.0, 0.0
    is_no_suspect = torch.ones(len(pilots), dtype=torch.bool)  # pilots that stand for all pixels but the suspects
    if resampled is not None:
        own = slice(resampled.suspects)  # rows of `resampled`
        suspects = resampled.pixels[own]
        suspects_error, suspects_variance = _actual_error(
            values[suspects], resampled.mean[own], resampled.variance[own]
        )
        is_no_suspect = ~torch.isin(pilots.pixels, suspects)
        # A second value that would be a suspect itself stands for other suspects, which are counted already.
        least = _excess(values[suspects], _neighbours(picture, suspects)).min() if len(suspects) else math.inf
        b = torch.where((_excess(b, neighbours) > least)[:, None], near, b)
    errors = error_at(a, b, near)  # (n, C)
    if resampled is not None:
        doubtful = slice(resampled.suspects, None)  # rows of `resampled`
        at = torch.isin(pilots.pixels, resampled.pixels[doubtful])  # in the order of the pilots, both
        radiance = torch.maximum(resampled.mean[doubtful].abs(), ((a[at] + b[at]) / 2 / MAX_PILOT_RATIO).abs())
        errors[at] = relative((a[at] - b[at]).square() / 2, radiance)
    errors = errors.mean(1)[is_no_suspect] * factor
    if not len(errors):
        return None
    pixels = len(values)
    # Pilots stand for the pixels that are no suspects; the mean of both values of a pilot has half the error of one.
    scale = (pixels - len(suspects)) / pixels * (1.0 - 0.5 * len(pilots) / pixels if b_counted else 1.0)
    weight = pilots.pixels_of_block[is_no_suspect] / sum_all(pilots.pixels_of_block[is_no_suspect])
    mean = float(sum_all(weight * errors))
    deviations = weight * (errors - mean) * scale
    total = suspects_error / pixels + mean * scale
    return _estimate(
        total,
        deviations,
        suspects_variance=suspects_variance / pixels**2,
        mostly_suspects=suspects_error / pixels > MAX_SUSPECT_FRACTION * total,
        errors=errors,
    )


def _first_value_factor(a: Tensor, b: Tensor, b_variance: Tensor | None) -> float:
    """Return the factor from half the squared difference of two values to the variance of the first: 1 if both vary alike.

    Second values made of two randomizations of half the length vary more, as the error of Sobol' points falls faster than that
    of random ones. The fraction of the difference's variance that first values have is estimated over all pilots and clamped to
    1/3 .. 1/2: it is 1/2 where the variance falls as one over the number of samples, 1/3 where it falls as the square of that.
    Arguments as for :func:`error_estimate`.
    """
    if b_variance is None:
        return 1.0
    scale = relative(1.0, (a + b) / 2)
    # Relative squares above 1 count as 1, so that no single pilot decides.
    both, second = (float(sum_all((x * scale).clamp_max(1.0))) for x in ((a - b).square(), b_variance))
    return 2.0 * min(max(1.0 - second / both, 1 / 3), 0.5) if both > 0.0 else 1.0


def _neighbours(picture: Tensor, pixels: Tensor) -> Tensor:
    """Return the eight neighbours ``(8, n, C)`` of pixels ``(n,)``; beyond the picture's edge, the nearest pixel within."""
    height, width, channels = picture.shape
    x, y = pixels % width, torch.div(pixels, width, rounding_mode="floor")
    steps = [(dx, dy) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dx or dy]
    at = [(y + dy).clamp(0, height - 1) * width + (x + dx).clamp(0, width - 1) for dx, dy in steps]
    return picture.reshape(-1, channels)[torch.stack(at)]


def _excess(values: Tensor, neighbours: Tensor) -> Tensor:
    """Return the relative squared excess ``(n,)`` of ``values (n, C)`` over the second brightest of ``(8, n, C)``."""
    second_brightest = neighbours.topk(2, 0).values[1]
    return relative((values - second_brightest).clamp_min(0.0).square(), neighbours.mean(0)).mean(1)


def _actual_error(values: Tensor, mean: Tensor, variance: Tensor) -> tuple[float, float]:
    """Return the summed squared error of resampled pixels over ``r² + 0.01``, and the variance of that sum.

    Args:
        values: values of the picture ``(m, C)``.
        mean: mean of the new values ``(m, C)``.
        variance: variance of ``mean`` ``(m, C)``.
    """
    radiance, difference = torch.maximum(mean.abs(), values.abs() / MAX_SUSPECT_RATIO), values - mean
    # The squared difference contains the variance of the mean, which is no error of the picture.
    errors = relative(difference.square() - variance, radiance)
    # Derivative of the error by the mean. Channels are correlated, so their standard deviations are added.
    slope = relative(2 * difference.abs() + 2 * radiance * errors.abs(), radiance)
    return float(sum_all(errors.mean(1))), float(sum_all((slope * variance.sqrt()).mean(1).square()))


def _estimate(
    mean: float, deviations: Tensor, *, suspects_variance: float, mostly_suspects: bool, errors: Tensor
) -> ErrorEstimate:
    """Return the estimate with its interval.

    Args:
        mean: the estimate.
        deviations: deviation of each pilot, such that the sum of squares is the variance of the mean ``(k,)``.
        suspects_variance: variance due to suspects.
        mostly_suspects: whether suspects have most of the error.
        errors: errors of the pilots ``(k,)``.
    """
    count = len(deviations)
    if not mean > 0.0 or not math.isfinite(mean):
        interval = (0.0, 0.0) if mean == 0.0 and count >= MIN_PILOTS else None
        return ErrorEstimate(mean, interval, heavy_tailed=not math.isfinite(mean))
    if count < MIN_PILOTS:
        return ErrorEstimate(mean, None, heavy_tailed=True)
    standard_error = math.sqrt(float(sum_all(deviations.square())) + suspects_variance)
    heavy = mostly_suspects or standard_error > MAX_STANDARD_ERROR * mean
    heavy = heavy or (count >= MIN_TAIL_VALUES and is_heavy_tailed(errors))
    # The logarithm has the standard error standard_error / mean; exp(300) stands for "no upper limit".
    factor = math.exp(min(_quantile(count - 1) * standard_error / mean, 300.0))
    return ErrorEstimate(mean, (mean / factor, mean * factor), heavy)


def _quantile(freedom: int) -> float:
    """Return the 97.5 % quantile of Student's t with ``freedom`` degrees of freedom.

    Abramowitz and Stegun 26.7.5, to the second term.
    """
    z = 1.959964  # the same quantile of the normal distribution
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)


# ---- Sample allocation for adaptive sampling, by blocks of pixels
#
# A pixel of n samples and relative variance ``e`` has the standard deviation ``s = sqrt(e n)`` a sample. For a given total the
# sum of ``s² / n`` over pixels is least for n in proportion to s. Pilots estimate ``e``, one a block: :func:`expected_errors`.
# Other pixels are not used, so that no pixel's number of samples depends on its own value, which would bias it. Numbers are
# powers of two times the first one, the best for Sobol' points.


#: Largest growth of the samples of a block in one round, as few pilots estimate its error: a power of two.
MAX_GROWTH = 4
#: Errors count as at least this fraction of the mean, as pilots may have missed rare contributions.
MIN_RELATIVE_ERROR = 0.05
#: Errors up to this quantile are smoothed over neighbouring blocks as they are.
TAIL_QUANTILE = 0.95


def expected_errors(errors: Tensor, known: Tensor) -> Tensor:
    """Return the expected error of each block ``(R, S)``.

    Most pilots tell the noise of their neighbourhood. A few large errors may be due to an edge, or to rare samples that are as
    likely elsewhere: following these would take samples from where the next ones will occur. So the part of errors above the
    95th percentile is used only as far as neighbouring pilots predict it, by regression; the rest is spread over all blocks.
    Without known blocks the result is 0.

    Args:
        errors: error of the pilot of each block, R rows and S columns of blocks ``(R, S)`` float64.
        known: True for blocks that have a pilot in the picture ``(R, S)`` bool.
    """
    if not bool(known.any()):
        return torch.zeros_like(errors)
    body = torch.minimum(errors, errors[known].quantile(TAIL_QUANTILE))
    tail = torch.where(known, errors - body, 0.0)
    mean = sum_all(tail) / sum_all(known.double())
    # Regression of each block's tail on that of its neighbours: the slope, clamped to 0 .. 1.
    predicted = _smoothed(tail, known, with_itself=False) - mean
    predictor = torch.where(known, predicted, 0.0)
    variance = float(sum_all(predictor.square()))
    slope = min(max(float(sum_all(predictor * (tail - mean))) / variance, 0.0), 1.0) if variance > 0.0 else 0.0
    return _smoothed(body, known) + mean + slope * (_smoothed(tail, known) - mean)


def _smoothed(values: Tensor, known: Tensor, *, with_itself: bool = True) -> Tensor:
    """Return means ``(R, S)`` of known blocks over 5 x 5 neighbourhoods with binomial weights.

    Where no block of the neighbourhood is known the result is the mean over all known ones.

    Args:
        values: value of each block ``(R, S)``.
        known: True for blocks whose value counts ``(R, S)``.
        with_itself: whether a block counts in its own mean.
    """
    kernel = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0], dtype=values.dtype)

    def convolved(x: Tensor) -> Tensor:
        for axis in (0, 1):
            padded = torch.nn.functional.pad(x, (2, 2, 0, 0) if axis else (0, 0, 2, 2))
            size = x.shape[axis]
            terms = [kernel[k] * padded.narrow(axis, k, size) for k in range(5)]
            x = terms[0] + terms[1] + terms[2] + terms[3] + terms[4]
        return x

    is_known = known.to(values.dtype)
    weight, total = convolved(is_known), convolved(values * is_known)
    if not with_itself:
        centre = kernel[2].square() * is_known
        weight, total = weight - centre, total - centre * values
    mean = sum_all(values * is_known) / sum_all(is_known).clamp_min(1.0)
    return torch.where(weight > 0, total / weight.clamp_min(1e-30), mean)


def allocate_samples(error: Tensor, counts: Tensor, pixels: Tensor, mean: float, *, last: bool = False) -> Tensor:
    """Return new numbers of samples a pixel of each block ``(B,)`` int64: the present ones times 1, 2 or 4.

    In the ``last`` round the remaining samples are given out as halves, quarters, ... of present numbers, until they do not
    suffice for one more sample of the pixels of any block.

    Args:
        error: relative variance of the pixels of each block ``(B,)`` float64, at its present number of samples.
        counts: present numbers of samples a pixel ``(B,)`` int64.
        pixels: number of pixels of each block ``(B,)``.
        mean: mean number of samples a pixel over the picture after the round, not to be exceeded.
        last: whether no round follows.
    """
    positive = error.clamp_min(0.0)
    floor = MIN_RELATIVE_ERROR * sum_all(positive * pixels) / sum_all(pixels.double())
    # Standard deviation of a single sample: the ideal numbers of samples are in proportion to it.
    deviation = (positive.clamp_min(floor) * counts).sqrt()
    present, most = counts.double(), (MAX_GROWTH * counts).double()
    total = mean * float(sum_all(pixels.double()))
    if not bool((deviation > 0).any()):
        deviation = torch.ones_like(deviation)
    # Bisect the number of samples per unit of deviation that gives the total; 60 halvings exhaust float64.
    low, high = 0.0, float((most / deviation.clamp_min(1e-30)).max())
    for _ in range(60):
        middle = 0.5 * (low + high)
        if float(sum_all(torch.minimum(torch.maximum(present, middle * deviation), most) * pixels)) < total:
            low = middle
        else:
            high = middle
    growth = torch.minimum(torch.maximum(present, low * deviation), most) / present  # (B,) from 1 to MAX_GROWTH
    # The 1e-9 keeps a growth of 2 or 4, less a rounding error, from being rounded down.
    doublings = growth.log2().add(1e-9).floor().clamp(0, 2).long()
    new_counts = counts << doublings
    # Remaining samples go to the blocks that are furthest below their ideal numbers: each is doubled while the total allows it.
    order = (growth / (1 << doublings)).argsort(descending=True, stable=True)
    order = order[doublings[order] < 2]
    spent = ((new_counts * pixels)[order]).cumsum(0)
    remaining = total - float((new_counts * pixels).sum())
    new_counts[order[spent <= remaining]] *= 2
    return _filled_up(new_counts, growth * present, pixels, total) if last else new_counts


def _filled_up(counts: Tensor, ideal: Tensor, pixels: Tensor, total: float) -> Tensor:
    """Return numbers of samples ``(B,)`` whose total over all pixels comes as near to ``total`` as possible from below.

    Args:
        counts: numbers to start with ``(B,)``; changed in place.
        ideal: ideal, fractional numbers ``(B,)``: blocks furthest below them come first.
        pixels: number of pixels of each block ``(B,)``.
        total: total number of samples.
    """
    order, halvings = (ideal / counts).argsort(descending=True, stable=True), 0
    while True:
        halvings += 1
        more = (counts >> halvings).clamp_min(1)
        spent = (more * pixels)[order].cumsum(0)
        fits = order[spent <= total - float((counts * pixels).sum())]
        counts[fits] += more[fits]
        if not len(fits) and int(more.max()) == 1:
            return counts
