"""Sums of samples by pixel and randomization: the film that engines add chunks of samples to.

Samples ``i`` with the same ``i % R`` come from one of R independent randomizations of the sampler
(:mod:`torchpt.physics.samplers`); the film sums each randomization by itself, so that their spread estimates the variance.
Additions happen in the order of samples, whatever the threads, so sums have the same bits in every render.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.threads import mean_all
from torchpt.images.metrics import relative
from torchpt.physics.film.splats import SplatSums

__all__ = ["Film"]


class Film:
    """Sums of radiance (or of an AOV) by pixel and randomization, with the number of samples of each.

    Pixels are counted row by row. Channels come before pixels inside, as on lanes; pictures have them last.

    Args:
        width: width of the picture (after a crop) in pixels.
        height: height of the picture in pixels.
        randomizations: R, the number of randomizations that share the samples.
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
        *,
        splats: bool = False,
    ) -> None:
        self.width, self.height, self.randomizations, self.channels = width, height, randomizations, channels
        pixels = width * height
        self._first = torch.zeros(channels, pixels, dtype=torch.float64, device=device)
        self._sums = torch.zeros(randomizations, channels, pixels, dtype=torch.float64, device=device)
        self._counts = torch.zeros(randomizations, pixels, dtype=torch.int64, device=device)
        self.splats = SplatSums(pixels, randomizations, device) if splats else None

    @staticmethod
    def bytes_of(pixels: int, randomizations: int, channels: int = 3, *, splats: bool = False) -> int:
        """Return the size in bytes of a film of this many pixels."""
        # 8 bytes each: first samples, and for each randomization sums and a count.
        without_splats = 8 * pixels * (channels + randomizations * (channels + 1))
        return without_splats + (SplatSums.bytes_of(pixels, randomizations) if splats else 0)

    def add(self, radiance: Tensor, first_pixel: int, first_sample: int) -> None:
        """Add samples ``(C, S, n)``: ``S`` consecutive ones of ``n`` consecutive pixels, from the given indices on."""
        for target, value in self.writes_of_add(radiance, first_pixel, first_sample):
            target.copy_(value)

    def writes_of_add(self, radiance: Tensor, first_pixel: int, first_sample: int) -> list[tuple[Tensor, Tensor]]:
        """Return the changes that :meth:`add` would make: pairs of a view of this film and its new values.

        The film is not changed. Copying the values allocates nothing, so that on lack of memory all or nothing is added.
        """
        _, samples, n = radiance.shape
        pixels = slice(first_pixel, first_pixel + n)
        writes = []
        if first_sample == 0:
            writes.append((self._first[:, pixels], radiance[:, 0].double()))
        for k in {(first_sample + s) % self.randomizations for s in range(min(samples, self.randomizations))}:
            of_randomization = range((k - first_sample) % self.randomizations, samples, self.randomizations)
            sums = self._sums[k, :, pixels].clone()
            for s in of_randomization:
                sums += radiance[:, s]
            writes.append((self._sums[k, :, pixels], sums))
            writes.append((self._counts[k, pixels], self._counts[k, pixels] + len(of_randomization)))
        return writes

    def empty_part(self, pixels: int) -> Film:
        """Return an empty film for ``pixels`` of the pixels of this one; splats of its samples may go to all pixels."""
        part = Film(pixels, 1, self.randomizations, self._sums.device, self.channels)
        if self.splats is not None:
            part.splats = SplatSums(self.width * self.height, self.randomizations, self._sums.device)
        return part

    def randomization_of(self, sample: Tensor) -> Tensor:
        """Return the index of the randomization ``(k,)`` of each sample, by its index within its pixel ``(k,)`` int64."""
        return sample % self.randomizations

    def extract(self, pixels: Tensor) -> Film:
        """Return the pixels of the given indices ``(n,)`` int64 as a separate film, one row high, without splats."""
        part = self.empty_part(len(pixels))
        part._first, part._sums = self._first[:, pixels].contiguous(), self._sums[:, :, pixels].contiguous()
        part._counts = self._counts[:, pixels].contiguous()
        return part

    def write_back(self, pixels: Tensor, part: Film) -> None:
        """Overwrite the pixels that :meth:`extract` returned as ``part``, after more samples, and add its splats."""
        self._first[:, pixels], self._sums[:, :, pixels] = part._first, part._sums
        self._counts[:, pixels] = part._counts
        if self.splats is not None and part.splats is not None:
            self.splats.add_state(part.splats.state())

    def state(self) -> dict[str, Tensor]:
        """Return the tensors of the film by name, for a checkpoint."""
        state = {"sums": self._sums, "counts": self._counts, "first": self._first}
        return state if self.splats is None else {**state, "splats": self.splats.state()}

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
        total = self._sums[0].clone()
        for sums in self._sums[1:]:  # in order: torch's own order differs between devices
            total += sums
        mean = total / self._counts.sum(0).clamp_min(1)
        if self.splats is not None:
            splats = sum(self.splats.values(k) for k in range(self.randomizations))
            mean += splats / _samples_a_pixel(self._counts.sum(0))
        return mean

    def _mean_of(self, k: int) -> Tensor:
        """Return means of the pixels over the samples of randomization ``k`` ``(C, pixels)``."""
        mean = self._sums[k] / self._counts[k].clamp_min(1)
        if self.splats is not None:
            mean += self.splats.values(k) / _samples_a_pixel(self._counts[k])
        return mean

    def values(self) -> Tensor:
        """Return means of the pixels ``(pixels, C)`` float64; those without samples are black."""
        return self._mean().T.contiguous()

    def randomization_means(self) -> list[Tensor]:
        """Return the means of the pixels by each randomization, R times ``(pixels, C)`` float64."""
        return [self._mean_of(k).T.contiguous() for k in range(self.randomizations)]

    @property
    def sums(self) -> Tensor:
        """Sums of samples ``(randomizations, C, pixels)`` float64, to which kernels add; then :meth:`count_samples`."""
        return self._sums

    def count_samples(self, first_pixel: int, pixels: int, first_sample: int, samples: int) -> None:
        """Count ``samples`` consecutive samples of ``pixels`` consecutive pixels, which a kernel has added to :attr:`sums`."""
        counts: Any = self._counts.numpy() if self._counts.is_cpu else self._counts
        for k in range(self.randomizations):
            # Number of sample indices that are `k` modulo the randomizations.
            number = len(range((k - first_sample) % self.randomizations, samples, self.randomizations))
            counts[k, first_pixel : first_pixel + pixels] += number

    def set_first_samples(self, values: np.ndarray | Tensor, first_pixel: int) -> None:
        """Store the first samples ``(C, n)`` of ``n`` consecutive pixels, which a kernel has added to :attr:`sums`.

        ``values``: an array on the host, else a tensor on the film's device.
        """
        if isinstance(values, Tensor):
            self._first[:, first_pixel : first_pixel + values.shape[1]] = values
            return
        # By numpy: torch would start a team of threads for each thread that renders.
        self._first.numpy()[:, first_pixel : first_pixel + values.shape[1]] = values

    def mean(self) -> Tensor:
        """Return the picture ``(H, W, C)`` in float64; pixels without samples are black."""
        return self._picture(self._mean())

    def first_samples(self) -> Tensor:
        """Return the first sample of each pixel ``(H, W, C)``, for AOVs that cannot be averaged."""
        return self._picture(self._first)

    def _picture(self, values: Tensor) -> Tensor:
        """Return values ``(C, pixels)`` as a picture ``(H, W, C)``."""
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
            mean += self._mean_of(k)
        mean /= len(filled)
        spread = torch.zeros_like(mean)
        for k in filled:
            spread += (self._mean_of(k) - mean).square_()
        spread /= len(filled) - 1
        return self._picture(spread / len(filled))

    def relmse(self) -> float | None:
        """Return the relative mean squared error of :meth:`mean`, estimated from :meth:`variance`; None without it."""
        variance = self.variance()
        if variance is None:
            return None
        return float(mean_all(relative(variance, self.mean())))


def _samples_a_pixel(counts: Tensor) -> Tensor:
    """Return the mean ``()`` of the numbers of samples of all pixels ``(pixels,)``; 1 without samples."""
    total = counts.sum().double()
    mean = total / torch.full_like(total, len(counts))  # by a tensor: GPUs multiply by the reciprocal of a number
    return torch.where(mean > 0, mean, 1.0)
