"""Samples that are not finite: how many there were, and which the first ones are. They count as black.

Renders only count; what is kept is enough to trace a few of them again (:mod:`torchpt.paths.explain`), since a path is a
function of its pixel, sample and stream.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchpt.paths.wave import PixelSet
from torchpt.physics.samplers import Randomizations

__all__ = ["KEPT", "NonFinite", "SampleId"]

#: How many are kept, and traced again: the first ones of the picture, whichever thread took them.
KEPT = 64


@dataclass(frozen=True)
class SampleId:
    """One sample.

    Attributes:
        sample: its number in the pixel.
        y, x: the pixel on the whole film.
        first, streams: which streams share the pixel's samples, see :class:`torchpt.physics.samplers.Randomizations`.
        nan: whether it was NaN; else it was infinite.
    """

    sample: int
    y: int
    x: int
    first: int = 0
    streams: int = 1
    nan: bool = True

    @property
    def sort_key(self) -> tuple[int, ...]:
        """By which they are ordered: those of the picture first, then those of pilots, each as they are taken."""
        return self.first, self.sample, self.y, self.x

    def __str__(self) -> str:
        return f"sample {self.sample} of pixel ({self.x}, {self.y})"


@dataclass
class NonFinite:
    """Samples that were not finite.

    Attributes:
        nan: how many held a NaN.
        infinite: how many of the others were infinite.
        places: the first :data:`KEPT` of them, in order.
    """

    nan: int = 0
    infinite: int = 0
    places: list[SampleId] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Return how many there were."""
        return self.nan + self.infinite

    def add(self, other: NonFinite) -> None:
        """Count those of ``other`` too."""
        if other.count:
            self.nan += other.nan
            self.infinite += other.infinite
            self.places = sorted([*self.places, *other.places], key=lambda place: place.sort_key)[:KEPT]

    def plain(self) -> dict[str, Any]:
        """As plain values, for a checkpoint."""
        places = [[p.sample, p.y, p.x, p.first, p.streams, p.nan] for p in self.places]
        return {"nan": self.nan, "infinite": self.infinite, "places": places}

    @staticmethod
    def read(facts: dict[str, Any]) -> NonFinite:
        """Return what :meth:`plain` made.

        Raises:
            ValueError: something that it does not make.
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
        """Those of a chunk. It looks at every value: to be asked only where some are known to be lost.

        Args:
            radiance: ``(3, samples, pixels)``.
            first_pixel: of the plate's.
            first_sample: of theirs.
            crop: ``(x, y, width, height)`` of the picture on the film.
            pixel_set: what is sampled; None: the picture, by one stream.
        """
        bad = ~torch.isfinite(radiance).all(0)
        nan = torch.isnan(radiance).any(0)
        count, nans = int(bad.sum()), int(nan.sum())
        streams = Randomizations() if pixel_set is None else pixel_set.streams
        places = []
        for s, p in bad.nonzero()[:KEPT].tolist():
            pixel = first_pixel + p
            pixel = pixel if pixel_set is None or pixel_set.places is None else int(pixel_set.places[pixel])
            y, x = divmod(pixel, crop[2])
            of_nan = bool(nan[s, p])
            places.append(SampleId(first_sample + s, y + crop[1], x + crop[0], streams.first, streams.count, of_nan))
        return NonFinite(nans, count - nans, places)
