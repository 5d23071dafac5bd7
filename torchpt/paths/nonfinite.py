"""Samples that are NaN or infinite: their number, and the identity of the first ones. They count as black.

A path is a function of its pixel, sample and randomization, so the identity is enough to trace it again and find the cause
(:mod:`torchpt.paths.explain`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpt.paths.wave import PixelSet
from torchpt.physics.samplers import Randomizations

__all__ = ["KEPT", "NonFinite", "SampleId"]

#: How many of the samples are recorded, and traced again: the first of the picture, independent of threads.
KEPT = 64


@dataclass(frozen=True)
class SampleId:
    """Identity of one sample.

    Attributes:
        sample: index in the pixel.
        y, x: row and column of the pixel on the whole film.
        first_randomization, randomizations: index of the first of the randomizations that share the pixel's samples, and their
            number: the fields of :class:`torchpt.physics.samplers.Randomizations`.
        nan: True: it was NaN. False: infinite.
    """

    sample: int
    y: int
    x: int
    first_randomization: int = 0
    randomizations: int = 1
    nan: bool = True

    @property
    def sort_key(self) -> tuple[int, ...]:
        """Return the sort key: samples of the picture first, then those of error probes, each in the order of sampling."""
        return self.first_randomization, self.sample, self.y, self.x

    def __str__(self) -> str:
        return f"sample {self.sample} of pixel ({self.x}, {self.y})"


@dataclass
class NonFinite:
    """Counts of samples that were not finite.

    Attributes:
        nan: how many had a NaN in a channel.
        infinite: how many of the others were infinite.
        samples: the first :data:`KEPT` of them, sorted.
    """

    nan: int = 0
    infinite: int = 0
    samples: list[SampleId] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Return the number of samples that were not finite."""
        return self.nan + self.infinite

    def add(self, other: NonFinite) -> None:
        """Add the counts and samples of ``other``."""
        if other.count:
            self.nan += other.nan
            self.infinite += other.infinite
            self.samples = sorted([*self.samples, *other.samples], key=lambda place: place.sort_key)[:KEPT]

    def plain(self) -> dict[str, Any]:
        """Return a dict of plain values, for a checkpoint."""
        places = [[p.sample, p.y, p.x, p.first_randomization, p.randomizations, p.nan] for p in self.samples]
        return {"nan": self.nan, "infinite": self.infinite, "places": places}

    @staticmethod
    def read(facts: dict[str, Any]) -> NonFinite:
        """Return the counts from the dict that :meth:`plain` made.

        Raises:
            ValueError: a malformed dict.
        """
        try:
            counts, places = [facts["nan"], facts["infinite"]], facts["places"]
            whole = all(type(n) is int and 0 <= n < 2**62 for row in (counts, *(p[:5] for p in places)) for n in row)
            if not whole or len(places) > KEPT or any(len(p) != 6 or type(p[5]) is not bool for p in places):
                raise ValueError("lost samples")
        except (KeyError, TypeError):
            raise ValueError("lost samples") from None
        return NonFinite(facts["nan"], facts["infinite"], [SampleId(*place) for place in facts["places"]])

    @staticmethod
    def of(
        radiance: Tensor,
        first_pixel: int,
        first_sample: int,
        crop: tuple[int, int, int, int],
        pixel_set: PixelSet | None = None,
    ) -> NonFinite:
        """Return the counts of a chunk. It reads every value: call it only where some sample is not finite.

        Args:
            radiance: ``(3, samples, pixels)``.
            first_pixel: index of the first pixel in the pixel set.
            first_sample: index of the first sample of each pixel.
            crop: ``(x, y, width, height)`` of the picture on the film.
            pixel_set: None: all pixels of the picture, with one randomization.
        """
        bad = ~torch.isfinite(radiance).all(0)
        nan = torch.isnan(radiance).any(0)
        count, nans = int(bad.sum()), int(nan.sum())
        streams = Randomizations() if pixel_set is None else pixel_set.randomizations
        places = []
        for s, p in bad.nonzero()[:KEPT].tolist():
            pixel = first_pixel + p
            pixel = pixel if pixel_set is None or pixel_set.indices is None else int(pixel_set.indices[pixel])
            y, x = divmod(pixel, crop[2])
            of_nan = bool(nan[s, p])
            places.append(SampleId(first_sample + s, y + crop[1], x + crop[0], streams.first, streams.count, of_nan))
        return NonFinite(nans, count - nans, places)
