"""Sums of samples by pixel and randomization."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchpt.core.threads import mean_all
from torchpt.images.metrics import relative
from torchpt.physics.film.splats import SplatSums

__all__ = ["Film"]


class Film:
    """Sums of radiance per pixel and randomization.

    Args:
        width: width of the picture (after a crop) in pixels.
        height: height of the picture in pixels.
        randomizations: number of independent sequences that share the samples, see :mod:`torchpt.physics.samplers`.
        device: device of the lanes.
        channels: C, three for radiance.
        splats: True: integrators splat to other pixels. The value of a pixel is then the mean of its own samples plus its
            splats over the mean number of samples of all pixels.

    Attributes:
        splats: sums of splats; None without splats.
    """

    def __init__(
        self,
        width: int,
        height: int,
        randomizations: int,
        device: torch.device,
        channels: int = 3,
        splats: bool = False,
    ) -> None:
        self.width, self.height, self.randomizations, self.channels = width, height, randomizations, channels
        pixels = width * height
        self._first = torch.zeros(channels, pixels, dtype=torch.float64, device=device)
        self._sums = torch.zeros(randomizations, channels, pixels, dtype=torch.float64, device=device)
        self._counts = torch.zeros(randomizations, pixels, dtype=torch.int64, device=device)
        self.splats = SplatSums(pixels, randomizations, device) if splats else None

    @staticmethod
    def bytes_of(pixels: int, randomizations: int, channels: int = 3, splats: bool = False) -> int:
        """Return the size in bytes of a film of this many pixels."""
        # 8 bytes each: first samples, and for each randomization sums and a count.
        own = 8 * pixels * (channels + randomizations * (channels + 1))
        return own + (SplatSums.bytes_of(pixels, randomizations) if splats else 0)

    def add(self, radiance: Tensor, first_pixel: int, first_sample: int) -> None:
        """Add samples ``(C, S, n)``: ``S`` consecutive ones of ``n`` consecutive pixels, from the given indices on."""
        for place, value in self.after(radiance, first_pixel, first_sample):
            place.copy_(value)

    def after(self, radiance: Tensor, first_pixel: int, first_sample: int) -> list[tuple[Tensor, Tensor]]:
        """Return the changes that :meth:`add` would make: pairs of a view of this film and its new values.

        The film is not changed. Copying the values allocates nothing, so that on lack of memory all or nothing is added.
        """
        count, n = radiance.shape[1], radiance.shape[2]
        pixels = slice(first_pixel, first_pixel + n)
        changed = []
        if first_sample == 0:
            changed.append((self._first[:, pixels], radiance[:, 0].double()))
        for group in {(first_sample + s) % self.randomizations for s in range(min(count, self.randomizations))}:
            own = range((group - first_sample) % self.randomizations, count, self.randomizations)
            sums = self._sums[group, :, pixels].clone()
            for s in own:
                sums += radiance[:, s]
            changed.append((self._sums[group, :, pixels], sums))
            changed.append((self._counts[group, pixels], self._counts[group, pixels] + len(own)))
        return changed

    def part(self, pixels: int) -> Film:
        """Return an empty film for some of its pixels, whose samples may send splats to all of them."""
        part = Film(pixels, 1, self.randomizations, self._sums.device, self.channels)
        if self.splats is not None:
            part.splats = SplatSums(self.width * self.height, self.randomizations, self._sums.device)
        return part

    def stream(self, sample: Tensor) -> Tensor:
        """Return the randomization of each sample ``(k,)`` of a pixel, by its index."""
        return sample % self.randomizations

    def taken(self, places: Tensor) -> Film:
        """Return some of the pixels as a separate film, whose sums of splats are empty."""
        part = self.part(len(places))
        part._first, part._sums = self._first[:, places].contiguous(), self._sums[:, :, places].contiguous()
        part._counts = self._counts[:, places].contiguous()
        return part

    def put(self, places: Tensor, part: Film) -> None:
        """Write back pixels from :meth:`taken` after more samples, and add their splats."""
        self._first[:, places], self._sums[:, :, places] = part._first, part._sums
        self._counts[:, places] = part._counts
        if self.splats is not None and part.splats is not None:
            self.splats.join(part.splats.state())

    def state(self) -> dict[str, Tensor]:
        """Return the tensors of the film by name, for a checkpoint."""
        own = {"sums": self._sums, "counts": self._counts, "first": self._first}
        return own if self.splats is None else {**own, "splats": self.splats.state()}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Load the :meth:`state` of another film of the same size.

        Raises:
            ValueError: the state of a film of another size.
        """
        for name, value in self.state().items():
            if state[name].shape != value.shape or state[name].dtype != value.dtype:
                raise ValueError(f"{name} of a film of another size")
            value.copy_(state[name])

    @property
    def counts(self) -> Tensor:
        """Samples of each pixel ``(pixels,)`` int64."""
        return self._counts.sum(0)

    def _mean(self) -> Tensor:
        """Return means of the pixels ``(C, pixels)``."""
        mean = self._sums.sum(0) / self._counts.sum(0).clamp_min(1)
        if self.splats is not None:
            total = sum(self.splats.values(k) for k in range(self.randomizations))
            mean += total / _samples(self._counts.sum(0))
        return mean

    def _stream(self, k: int) -> Tensor:
        """Return means of the pixels by one randomization ``(C, pixels)``."""
        mean = self._sums[k] / self._counts[k].clamp_min(1)
        if self.splats is not None:
            mean += self.splats.values(k) / _samples(self._counts[k])
        return mean

    def values(self) -> Tensor:
        """Return means of the pixels ``(pixels, C)`` float64; those without samples are black."""
        return self._mean().T.contiguous()

    def streams(self) -> list[Tensor]:
        """Return the means by each randomization ``(pixels, C)`` float64."""
        return [self._stream(k).T.contiguous() for k in range(self.randomizations)]

    @property
    def sums(self) -> Tensor:
        """Sums of samples ``(randomizations, C, pixels)`` float64."""
        return self._sums

    def counted(self, first_pixel: int, pixels: int, first_sample: int, samples: int) -> None:
        """Count consecutive samples that were added to :attr:`sums` of consecutive pixels."""
        counts = self._counts.numpy()
        for group in range(self.randomizations):
            # Number of sample indices that are `group` modulo the randomizations.
            number = len(range((group - first_sample) % self.randomizations, samples, self.randomizations))
            counts[group, first_pixel : first_pixel + pixels] += number

    def keep_first(self, values: np.ndarray, first_pixel: int) -> None:
        """Keep the first samples ``(C, n)`` of consecutive pixels."""
        # By numpy: torch would start a team of threads for each thread that renders.
        self._first.numpy()[:, first_pixel : first_pixel + values.shape[1]] = values

    def mean(self) -> Tensor:
        """Return the picture ``(H, W, C)`` in float64; pixels without samples are black."""
        return self._picture(self._mean())

    def first(self) -> Tensor:
        """Return the first sample of each pixel ``(H, W, C)``, for AOVs that cannot be averaged."""
        return self._picture(self._first)

    def _picture(self, values: Tensor) -> Tensor:
        return values.T.reshape(self.height, self.width, -1)

    def variance(self) -> Tensor | None:
        """Return the variance of :meth:`mean` ``(H, W, C)`` from the spread of randomizations; None for fewer than two.

        Randomizations have equal weights, also if some have one sample more: the estimate is exact for equal counts.
        """
        filled = [k for k in range(self.randomizations) if int(self._counts[k].min()) > 0]
        if len(filled) < 2:
            return None
        # One randomization at a time, to save memory on large films.
        mean = torch.zeros_like(self._first)
        for k in filled:
            mean += self._stream(k)
        mean /= len(filled)
        spread = torch.zeros_like(mean)
        for k in filled:
            spread += (self._stream(k) - mean).square_()
        spread /= len(filled) - 1
        return self._picture(spread / len(filled))

    def relmse(self) -> float | None:
        """Return the relMSE estimated from :meth:`variance`; None without it."""
        variance = self.variance()
        if variance is None:
            return None
        return float(mean_all(relative(variance, self.mean())))


def _samples(counts: Tensor) -> Tensor:
    """Return the mean number of samples a pixel, 1 without samples."""
    mean = counts.double().mean()
    return torch.where(mean > 0, mean, 1.0)
