"""Error probes, and adaptive sampling that is guided by them.

Error probes (also called pilots) are one pixel of each block of 4 x 4. They are sampled a second time with independent random
numbers; the two values of a probe differ by its noise, which gives the relMSE of the picture, and tells adaptive sampling where
to go. Outliers among them are sampled a third time at the end. :class:`~torchpt.rendering.run.Run` samples the spans that these
classes return (pixel set, first sample, number of samples); ``torchpt.physics.film.error`` has the statistics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.engines.engine import SampleRange
from torchpt.paths.wave import PixelSet, Wave
from torchpt.physics.film import ErrorEstimate, Film, Pilots, pilots_of
from torchpt.physics.film.error import (
    BLOCK,
    RESAMPLING_RANDOMIZATIONS,
    Resampled,
    allocate_samples,
    error_by_pilots,
    error_estimate,
    expected_errors,
    pixels_to_resample,
    probe_estimate,
    resample_counts,
)
from torchpt.physics.samplers import Randomizations
from torchpt.scene.settings import Settings

__all__ = ["FIRST_ROUND", "ErrorProbes", "SampleAllocation", "error_probes"]


# ---- Error probes: pixels that are sampled a second time with independent random numbers


@dataclass
class ErrorProbes:
    """The error probes of a render and their second values.

    Without adaptive sampling the second values are averaged into the picture. Adaptive sampling allocates samples by them; so
    that this does not bias the pixels, it leaves them out of the picture and takes them in two randomizations, whose difference
    gives their own variance.

    Attributes:
        pilots: the pixels.
        pixel_set: the pixels with the film of their second values.
        counts_second_values: True if the picture includes the second values.
        resampled: third values of outliers and of uncertain pixels, and the number of outliers; None: not sampled yet.
        resampled_at: samples a pixel of the picture when third values were taken; None: not yet.
    """

    pilots: Pilots
    pixel_set: PixelSet
    counts_second_values: bool
    resampled: tuple[PixelSet, int] | None = None
    resampled_at: float | None = None

    def picture(self, film: Film) -> Tensor:
        """Return the picture ``(H, W, 3)`` in float64, with the second values where they count."""
        if not self.counts_second_values or not len(self.pilots):
            return film.mean()
        pixels, second = self.pixel_set.indices, self.pixel_set.film
        values, first_count = film.values(), film.counts[pixels].double()
        second_count = second.counts.double()
        share = (second_count / (first_count + second_count).clamp_min(1.0))[:, None]
        values[pixels] += share * (second.values() - values[pixels])
        return values.reshape(film.height, film.width, -1)

    def counts(self, film: Film) -> Tensor:
        """Return the number of samples of each pixel ``(pixels,)`` int64."""
        counts = film.counts
        if self.counts_second_values and len(self.pilots):
            counts[self.pixel_set.indices] += self.pixel_set.film.counts
        return counts

    def estimate(self, film: Film, picture: Tensor) -> ErrorEstimate | None:
        """Return the error estimate of ``picture``, which is :meth:`picture` of the film; None without probes."""
        if not len(self.pilots) or int(self.pixel_set.film.counts.min()) == 0:
            return None
        third = None
        if self.resampled is not None:
            pixel_set, outliers = self.resampled  # the outliers come first
            values = torch.stack(pixel_set.film.randomization_means()).cpu()
            assert pixel_set.indices is not None
            third = Resampled(pixel_set.indices.cpu(), outliers, values.mean(0), values.var(0) / len(values))
        first = self._first(film)
        return error_estimate(
            picture.cpu(),
            self.pilots,
            first,
            self._second(),
            self._second_variance(),
            b_counted=self.counts_second_values,
            resampled=third,
        )

    def resampling_share(self, pixels: int) -> float:
        """Return the samples that third values take, as a share of the samples of a picture of ``pixels`` pixels."""
        return (
            RESAMPLING_RANDOMIZATIONS * sum(resample_counts(pixels, len(self.pilots))) / pixels
            if len(self.pilots)
            else 0.0
        )

    def resample_outliers(
        self, film: Film, from_first_rank: Callable[[Tensor], Tensor] | None = None
    ) -> list[SampleRange]:
        """Choose the pixels to resample for a better error estimate, and return their spans: pixels, first sample, count.

        ``from_first_rank`` replaces integers ``(n,)`` by those of the first rank; None: one process renders.
        """
        if not len(self.pilots):
            return []
        picture, first = self.picture(film).cpu(), self._first(film)
        outliers, uncertain = pixels_to_resample(picture, self.pilots, first, self._second())
        if from_first_rank is not None:
            outliers, uncertain = from_first_rank(outliers), from_first_rank(uncertain)
        pixels = torch.cat((outliers, uncertain)).to(film.sums.device)
        randomizations = Randomizations(
            first=self.pixel_set.randomizations.first + self.pixel_set.randomizations.count,
            count=RESAMPLING_RANDOMIZATIONS,
        )
        third_values = Film(len(pixels), 1, RESAMPLING_RANDOMIZATIONS, film.sums.device)  # one row of pixels
        pixel_set = PixelSet(third_values, layers={}, randomizations=randomizations, indices=pixels)
        self.resampled = pixel_set, len(outliers)
        self.resampled_at = float(film.counts.double().mean())
        samples = round(self.resampled_at)
        return [(pixel_set, 0, RESAMPLING_RANDOMIZATIONS * samples)]

    def probe_estimate(self, film: Film) -> ErrorEstimate | None:
        """Return the error estimate that the probes give without third values; None without probes."""
        if not len(self.pilots):
            return None
        return probe_estimate(
            self.pilots, self._first(film), self._second(), self._second_variance(), b_counted=self.counts_second_values
        )

    def _first(self, film: Film) -> Tensor:
        """Return the first values of the probes ``(probes, 3)``: those of the picture."""
        assert self.pixel_set.indices is not None
        return film.extract(self.pixel_set.indices).values().cpu()

    def _second(self) -> Tensor:
        """Return the second values of the probes ``(probes, 3)``."""
        return self.pixel_set.film.values().cpu()

    def _second_variance(self) -> Tensor | None:
        """Return the variance of the second values where it differs from that of the first ones; else None."""
        if self.counts_second_values:
            return None
        one, other = self.pixel_set.film.randomization_means()
        return ((one - other).square() / 4).cpu()  # of the mean of two equal halves


def error_probes(wave: Wave, settings: Settings, device: torch.device) -> ErrorProbes:
    """Return the error probes of a render, before any sample."""
    film = settings.film
    pilots = pilots_of(settings.render.seed, (film.width, film.height), wave.crop)
    # The first ones are the picture's.
    randomizations = Randomizations(first=wave.sampler.randomizations, count=2 if settings.adaptive else 1)
    sums = Film(len(pilots), 1, randomizations.count, device)
    pixel_set = PixelSet(sums, layers={}, randomizations=randomizations, indices=pilots.pixels.to(device))
    return ErrorProbes(pilots=pilots, pixel_set=pixel_set, counts_second_values=not settings.adaptive)


# ---- Adaptive sampling: error probes decide where samples go


#: Samples of every pixel before adaptive sampling begins: fewer tell too little about the variance of a pixel.
FIRST_ROUND = 16


class SampleAllocation:
    """Allocates the samples of adaptive rounds to the 4 x 4 blocks of a picture.

    Args:
        pilots: the error probes of the picture.
        film: the film of the picture.
        from_first_rank: replaces integers ``(n,)`` by those of the first rank; None: one process renders.
    """

    def __init__(self, pilots: Pilots, film: Film, from_first_rank: Callable[[Tensor], Tensor] | None = None) -> None:
        self.pilots, self._from_first_rank = pilots, from_first_rank
        # Coordinates from the corner of the first block, which a crop may cut.
        left, top = pilots.corner
        x, y = torch.arange(film.width) + left, torch.arange(film.height) + top
        rows, columns = pilots.blocks
        #: Block index of each pixel ``(pixels,)``.
        self.block = ((y // BLOCK)[:, None] * columns + (x // BLOCK)[None]).reshape(-1)
        #: Number of pixels of each block ``(blocks,)``.
        self.pixels = torch.bincount(self.block, minlength=rows * columns)
        self._parts: list[tuple[Film, Tensor, Film]] = []  # film, pixels taken from it, film of these pixels

    def spans(self, picture: PixelSet, probes: ErrorProbes, mean: float, *, last: bool) -> list[SampleRange]:
        """Return the next round's spans (pixels, first sample, count), after which the picture has ``mean`` samples a pixel.

        Pixels of one span have the same number of samples. ``last``: no round follows, see
        :func:`torchpt.physics.film.error.allocate_samples`.
        """
        device = picture.film.sums.device
        counts = self._block_counts(picture.film.counts.cpu())
        # Samples a pixel of each block before and after the round, (blocks,).
        aims = allocate_samples(self._errors(probes), counts, self.pixels, mean, last=last)
        spans: list[SampleRange] = []
        if self._from_first_rank is not None:
            aims = self._from_first_rank(aims)
        # One span for each pair of these, packed into one integer to find the different ones.
        base = int(aims.max()) + 1
        pairs = (counts * base + aims)[aims > counts].unique().tolist()
        pilot_blocks = self.block[self.pilots.pixels]
        for have, aim in (divmod(pair, base) for pair in pairs):
            chosen = (counts == have) & (aims == aim)
            pixels = chosen[self.block].nonzero()[:, 0].to(device)
            spans.append((self._part(picture, pixels, pixels), have, aim - have))
            probe_indices = chosen[pilot_blocks].nonzero()[:, 0]
            if len(probe_indices):
                probe_pixels = self.pilots.pixels[probe_indices].to(device)
                part = self._part(probes.pixel_set, probe_indices.to(device), probe_pixels)
                spans.append((part, have, aim - have))
        return spans

    def merge(self) -> None:
        """Add the samples of the round to the films that its pixels were taken from."""
        for whole, pixels, part in self._parts:
            whole.write_back(pixels, part)
        self._parts.clear()

    def _part(self, pixel_set: PixelSet, members: Tensor, pixels: Tensor) -> PixelSet:
        """Return some pixels of a pixel set as a set with films of their own.

        Args:
            pixel_set: the whole set.
            members: indices of the pixels in the set ``(n,)``.
            pixels: indices of the same pixels in the picture ``(n,)``.
        """
        films = {}
        for name, film in (("", pixel_set.film), *pixel_set.layers.items()):
            films[name] = film.extract(members)
            self._parts.append((film, members, films[name]))
        return PixelSet(film=films.pop(""), layers=films, randomizations=pixel_set.randomizations, indices=pixels)

    def _block_counts(self, counts: Tensor) -> Tensor:
        """Return the samples a pixel of each block; the pixels of a block have the same number."""
        found = torch.zeros(len(self.pixels), dtype=torch.int64)
        found[self.block] = counts
        return found

    def _errors(self, probes: ErrorProbes) -> Tensor:
        """Return the relative variance of each block's pixels ``(blocks,)``, up to a factor, from the second values alone."""
        a, b = (means.cpu() for means in probes.pixel_set.film.randomization_means())
        errors, probed = a.new_zeros(self.pilots.blocks), torch.zeros(self.pilots.blocks, dtype=torch.bool)
        at = tuple(self.pilots.block)  # row and column of each probe's block
        errors[at], probed[at] = error_by_pilots(self.pilots, a, b), True
        return expected_errors(errors, probed).reshape(-1)
