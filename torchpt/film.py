"""The film: reconstruction filters by importance sampling, and sums that lose nothing.

A sample belongs to one pixel: its place is drawn from the filter (Ernst, Stamminger, Greiner, *Filter Importance Sampling*,
2006), so nothing is splatted and chunks of pixels are independent. Sums are float64, added sample by sample in order, one
sum for each randomization of the sampler: their spread is the picture's own error.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchpt.math.threads import mean_all

__all__ = ["RELMSE_FLOOR", "Film", "Filter"]

#: relMSE is the mean of ``(x - ref)^2 / (ref^2 + RELMSE_FLOOR)`` over pixels and channels.
RELMSE_FLOOR = 1e-2
_CELLS = 4096
#: Numbers in [0, 1) are multiples of one over this.
_STEPS = 1 << 24


def _gaussian(x: np.ndarray, radius: float, stddev: float) -> np.ndarray:
    """As Mitsuba's: shifted so that it ends at zero."""
    return np.maximum(np.exp(-0.5 * (x / stddev) ** 2) - np.exp(-0.5 * (radius / stddev) ** 2), 0.0)


def _mitchell(x: np.ndarray, b: float, c: float) -> np.ndarray:
    """Mitchell and Netravali, *Reconstruction Filters in Computer Graphics*, SIGGRAPH 1988, equation 8; its integral is 1."""
    x = np.abs(x)
    inner = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + (6 - 2 * b)
    outer = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + (8 * b + 24 * c)
    return np.where(x < 1, inner, np.where(x < 2, outer, 0.0)) / 6


@lru_cache(maxsize=16)  # takes milliseconds, which small renders repeated in a loop would notice
def _tables(kind: str, radius: float, stddev: float, b: float, c: float) -> tuple[np.ndarray, float]:
    """The inverse of the cumulative profile, made in float64 to be read linearly, and the share of each negative lobe."""
    x = np.linspace(-radius, radius, (1 << 16) + 1)
    middle = 0.5 * (x[1:] + x[:-1])
    weight = _gaussian(middle, radius, stddev) if kind == "gaussian" else _mitchell(middle, b, c)
    cdf = np.concatenate(([0.0], np.cumsum(np.abs(weight))))
    inverse = np.interp(np.linspace(0.0, 1.0, _CELLS + 1), cdf / cdf[-1], x)
    # The negative lobes are the outermost, each with a share of the numbers, in whole steps of 2^-24. Both are drawn by
    # the lowest numbers: the fewer ends of intervals, the more evenly stratified points share them out.
    lobe = round(float(np.abs(weight[: 1 << 15]).dot(weight[: 1 << 15] < 0)) / cdf[-1] * _STEPS) / _STEPS
    return inverse.astype(np.float32), lobe


class Filter:
    """A separable reconstruction filter that is sampled.

    Where a filter is negative, places are drawn from its magnitude and the sample is weighted by the filter's sign times
    the integral of the magnitude over that of the filter. The weight's expectation is 1: constants are kept without bias,
    and no sample depends on another as it would where sums are divided by sums of weights.

    Args:
        kind: ``box``, ``tent``, ``gaussian`` or ``mitchell``.
        radius: half width in pixels; mitchell's is 2 by definition.
        stddev: of the gaussian, in pixels.
        device: where the lanes live.
        b: parameter of mitchell, 0..1.
        c: parameter of mitchell, 0..1.

    Attributes:
        signed: whether samples have weights; else every weight is 1.
    """

    def __init__(
        self, kind: str, radius: float, stddev: float, device: torch.device, b: float = 1 / 3, c: float = 1 / 3
    ) -> None:
        self.kind, self.signed, self._inverse = kind, False, None
        self.radius = torch.tensor(radius, dtype=torch.float32, device=device)
        if kind in ("box", "tent"):
            return
        inverse, lobe = _tables(kind, radius, stddev, b, c)
        self._inverse = torch.from_numpy(inverse).to(device)
        self._lobe = torch.tensor(lobe, dtype=torch.float32, device=device)
        self.signed = lobe > 0

    def kind_of(self) -> tuple[object, ...]:
        """What is not a tensor: kernels are made anew where it differs."""
        return self.kind, self.signed

    def tensors(self) -> dict[str, Tensor]:
        """What lanes read."""
        found = {"radius": self.radius}
        return found if self._inverse is None else {**found, "inverse": self._inverse, "lobe": self._lobe}

    def offset(self, u: Tensor) -> Tensor:
        """Offsets from the pixel's centre, in pixels, for ``u`` in [0, 1): any shape."""
        if self.kind == "box":
            return (u - 0.5) * (2.0 * self.radius)
        if self.kind == "tent":
            t = 2.0 * u - 1.0
            return torch.copysign(1.0 - (1.0 - t.abs()).sqrt(), t) * self.radius
        assert self._inverse is not None
        if self.signed:
            u = torch.where(u < self._lobe, u + (1.0 - self._lobe), u - self._lobe)
        place = u * float(_CELLS)
        cell = place.to(torch.int64)
        low = torch.take(self._inverse, cell)
        return low + (torch.take(self._inverse, cell + 1) - low) * (place - cell)

    def weight(self, u: Tensor) -> Tensor:
        """Weights ``(N,)`` of samples at the offsets of ``u (2, N)``, of a filter that is ``signed``."""
        negative = u < 2.0 * self._lobe
        norm = 1.0 / (1.0 - 4.0 * self._lobe)
        return norm * norm * (1.0 - 2.0 * (negative[0] ^ negative[1]).to(u.dtype))


class Film:
    """Sums of radiance per pixel and randomization.

    Args:
        width: of the picture (after a crop) in pixels.
        height: of the picture in pixels.
        randomizations: independent sequences that share the samples, see :mod:`torchpt.samplers`.
        device: where the lanes live.
        channels: C, three for radiance.
    """

    def __init__(self, width: int, height: int, randomizations: int, device: torch.device, channels: int = 3) -> None:
        self.width, self.height, self.randomizations = width, height, randomizations
        pixels = width * height
        self._first = torch.zeros(channels, pixels, dtype=torch.float64, device=device)
        self._sums = torch.zeros(randomizations, channels, pixels, dtype=torch.float64, device=device)
        self._counts = torch.zeros(randomizations, pixels, dtype=torch.int64, device=device)

    def add(self, radiance: Tensor, first_pixel: int, first_sample: int) -> None:
        """Add samples ``(C, S, n)`` of ``n`` consecutive pixels, ``S`` consecutive samples each."""
        count, n = radiance.shape[1], radiance.shape[2]
        pixels = slice(first_pixel, first_pixel + n)
        if first_sample == 0:
            self._first[:, pixels] = radiance[:, 0].double()
        for s in range(count):
            group = (first_sample + s) % self.randomizations
            self._sums[group, :, pixels] += radiance[:, s]
            self._counts[group, pixels] += 1

    @property
    def sums(self) -> Tensor:
        """``(randomizations, C, pixels)`` float64."""
        return self._sums

    def counted(self, first_pixel: int, pixels: int, first_sample: int, samples: int) -> None:
        """Say that consecutive samples were added to the sums of consecutive pixels."""
        counts = self._counts.numpy()
        for group in range(self.randomizations):
            # Of the numbers from `first_sample` on those that are `group` modulo the randomizations.
            number = len(range((group - first_sample) % self.randomizations, samples, self.randomizations))
            counts[group, first_pixel : first_pixel + pixels] += number

    def keep_first(self, values: np.ndarray, first_pixel: int) -> None:
        """Keep the first samples ``(C, n)`` of consecutive pixels."""
        self._first[:, first_pixel : first_pixel + values.shape[1]] = torch.from_numpy(values)

    def mean(self) -> Tensor:
        """The picture ``(H, W, C)`` in float64; pixels without samples are black."""
        return self._picture(self._sums.sum(0) / self._counts.sum(0).clamp_min(1))

    def first(self) -> Tensor:
        """The first sample of each pixel ``(H, W, C)``: for what has no average."""
        return self._picture(self._first)

    def _picture(self, values: Tensor) -> Tensor:
        return values.T.reshape(self.height, self.width, -1)

    def variance(self) -> Tensor | None:
        """Variance of :meth:`mean` ``(H, W, C)``, from the spread of the randomizations; None where one is all there is.

        Randomizations with a sample more than the others weigh as much: the estimate is exact for equal counts.
        """
        filled = [k for k in range(self.randomizations) if int(self._counts[k].min()) > 0]
        if len(filled) < 2:
            return None
        # One randomization at a time: a large film has room for no more.
        mean = torch.zeros_like(self._first)
        for k in filled:
            mean += self._sums[k] / self._counts[k]
        mean /= len(filled)
        spread = torch.zeros_like(mean)
        for k in filled:
            spread += (self._sums[k] / self._counts[k] - mean).square_()
        spread /= len(filled) - 1
        return self._picture(spread / len(filled))

    def relmse(self) -> float | None:
        """The picture's estimate of its own relMSE."""
        variance = self.variance()
        if variance is None:
            return None
        return float(mean_all(variance / (self.mean() ** 2 + RELMSE_FLOOR)))
