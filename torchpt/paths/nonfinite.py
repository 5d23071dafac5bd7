"""Samples that are NaN or infinite: their number, and the identity of the first ones. They count as black.

A path is a function of its pixel, sample and randomization, so the identity is enough to trace it again and find the cause
(:mod:`torchpt.paths.explain`). Engines count them chunk by chunk, and a render adds the counts up
(:mod:`torchpt.rendering.run`).
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpt.paths.wave import PixelSet
from torchpt.physics.samplers import Randomizations

__all__ = ["KEPT", "NonFinite", "SampleId"]

#: How many of the samples are recorded, and traced again: the first by :attr:`SampleId.sort_key`, independent of threads.
#: Enough to name the causes, few enough that tracing them again takes no time.
KEPT = 64
#: Numbers in a checkpoint are below this; no render takes so many samples.
_LARGEST_NUMBER = 2**62


@dataclass(frozen=True)
class SampleId:
    """Identity of one sample.

    Attributes:
        sample: index in the pixel.
        y, x: row and column of the pixel on the whole film.
        first_randomization, randomizations: index of the first of the randomizations that share the pixel's samples, and their
            number: the fields of :class:`torchpt.physics.samplers.Randomizations`.
        nan: True: some channel was NaN. False: infinite.
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
            self.samples = sorted([*self.samples, *other.samples], key=lambda sample: sample.sort_key)[:KEPT]

    def plain(self) -> dict[str, Any]:
        """Return a dict of plain values, for a checkpoint: ``places`` has the fields of each sample as a list."""
        return {"nan": self.nan, "infinite": self.infinite, "places": [list(astuple(id_)) for id_ in self.samples]}

    @staticmethod
    def read(facts: dict[str, Any]) -> NonFinite:
        """Return the counts from the dict that :meth:`plain` made.

        Raises:
            ValueError: a malformed dict.
        """
        try:
            counts, places = [facts["nan"], facts["infinite"]], facts["places"]
            # Each place is five numbers and the flag `nan`.
            numbers = [counts, *(place[:-1] for place in places)]
            whole = all(type(n) is int and 0 <= n < _LARGEST_NUMBER for row in numbers for n in row)
            formed = all(len(place) == 6 and type(place[-1]) is bool for place in places)
            if not whole or not formed or len(places) > KEPT:
                raise ValueError("lost samples")
        except (KeyError, TypeError, IndexError):
            raise ValueError("lost samples") from None
        samples = [SampleId(*place) for place in places]
        return NonFinite(nan=facts["nan"], infinite=facts["infinite"], samples=samples)

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
            radiance: ``(3, samples, pixels)`` of the chunk's samples.
            first_pixel: index of the first pixel in the pixel set.
            first_sample: index of the first sample of each pixel.
            crop: ``(x, y, width, height)`` of the picture on the film.
            pixel_set: the pixels that ``first_pixel`` counts; None: all pixels of the picture, with one randomization.
        """
        bad = ~torch.isfinite(radiance).all(0)
        nan = torch.isnan(radiance).any(0)
        count, nans = int(bad.sum()), int(nan.sum())
        randomizations = Randomizations() if pixel_set is None else pixel_set.randomizations
        x0, y0, width, _ = crop
        samples = []
        for s, p in bad.nonzero()[:KEPT].tolist():  # rows are samples, so these are the first by their sort key
            pixel = first_pixel + p
            pixel = pixel if pixel_set is None or pixel_set.indices is None else int(pixel_set.indices[pixel])
            y, x = divmod(pixel, width)
            samples.append(
                SampleId(
                    sample=first_sample + s,
                    y=y + y0,
                    x=x + x0,
                    first_randomization=randomizations.first,
                    randomizations=randomizations.count,
                    nan=bool(nan[s, p]),
                )
            )
        return NonFinite(nan=nans, infinite=count - nans, samples=samples)
