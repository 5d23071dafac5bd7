"""The film: reconstruction filters by importance sampling, and sums that lose nothing.

A sample belongs to one pixel: its place is drawn from the filter (Ernst, Stamminger, Greiner, *Filter Importance Sampling*,
2006), so nothing is splatted and chunks of pixels are independent. Sums are float64, added sample by sample in order, one
sum for each randomization of the sampler: their spread is the picture's own error.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["RELMSE_FLOOR", "Film", "Filter"]

#: relMSE is the mean of ``(x - ref)^2 / (ref^2 + RELMSE_FLOOR)`` over pixels and channels.
RELMSE_FLOOR = 1e-2
_CELLS = 4096


def _profile(kind: str, radius: float, stddev: float, x: np.ndarray) -> np.ndarray:
    if kind == "gaussian":  # as Mitsuba: shifted so that it ends at zero
        floor = np.exp(-0.5 * (radius / stddev) ** 2)
        return np.maximum(np.exp(-0.5 * (x / stddev) ** 2) - floor, 0.0)
    raise ValueError(f"no profile for filter {kind!r}")


class Filter:
    """A separable reconstruction filter that is sampled.

    Args:
        kind: ``box`` or ``gaussian``.
        radius: half width in pixels.
        stddev: of the gaussian, in pixels.
        device: where the lanes live.
    """

    def __init__(self, kind: str, radius: float, stddev: float, device: torch.device) -> None:
        self.kind, self.radius, self._inverse = kind, radius, None
        if kind == "box":
            return
        # Inverse of the cumulative profile, tabulated in float64 and read linearly.
        x = np.linspace(-radius, radius, 1 << 16)
        weight = _profile(kind, radius, stddev, 0.5 * (x[1:] + x[:-1]))
        cdf = np.concatenate(([0.0], np.cumsum(weight)))
        inverse = np.interp(np.linspace(0.0, 1.0, _CELLS + 1), cdf / cdf[-1], x)
        self._inverse = torch.from_numpy(inverse.astype(np.float32)).to(device)

    def offset(self, u: Tensor) -> Tensor:
        """Offsets from the pixel's centre, in pixels, for ``u`` in [0, 1): any shape."""
        if self._inverse is None:
            return (u - 0.5) * (2.0 * self.radius)
        place = u * float(_CELLS)
        cell = place.to(torch.int64)
        low = torch.take(self._inverse, cell)
        return low + (torch.take(self._inverse, cell + 1) - low) * (place - cell)


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
        filled = self._counts.amin(1) > 0
        if int(filled.sum()) < 2:
            return None
        sums, counts = self._sums[filled], self._counts[filled]
        means = sums / counts[:, None]
        spread = (means - means.mean(0)).square().sum(0) / (len(means) - 1)
        return self._picture(spread / len(means))

    def relmse(self) -> float | None:
        """The picture's estimate of its own relMSE."""
        variance = self.variance()
        if variance is None:
            return None
        return float((variance / (self.mean() ** 2 + RELMSE_FLOOR)).mean())
