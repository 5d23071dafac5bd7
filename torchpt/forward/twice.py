"""The second values of a render's pilots: pixels that are sampled again by other random numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.film import Film, KnownError, Pilots, pilots_of
from torchpt.film.known_error import STREAMS, Again, again_counts, known_error, pilots_alone, to_look_at
from torchpt.integrators.plate import Plate
from torchpt.integrators.wave import Wave
from torchpt.samplers import Streams
from torchpt.settings import Settings

__all__ = ["Twice", "second_values"]


@dataclass
class Twice:
    """Pilots and their second values.

    Adaptive sampling decides by them where samples go. For no pixel to depend on it they are left out of the picture then, and
    are made of two streams, whose difference tells their own variance.

    Attributes:
        pilots: where they are.
        plate: sums of their second values.
        counted: whether these are part of the picture.
        third: what was looked at again, and how many of those pixels are suspects.
        looked: samples a pixel that the picture had then; None: nothing was looked at yet.
    """

    pilots: Pilots
    plate: Plate
    counted: bool
    third: tuple[Plate, int] | None = None
    looked: float | None = None

    def picture(self, film: Film) -> Tensor:
        """The picture ``(H, W, 3)`` in float64."""
        if not self.counted or not len(self.pilots):
            return film.mean()
        places, second = self.plate.places, self.plate.film
        values, first = film.values(), film.counts[places].double()
        again = second.counts.double()
        share = (again / (first + again).clamp_min(1.0))[:, None]
        values[places] += share * (second.values() - values[places])
        return values.reshape(film.height, film.width, -1)

    def counts(self, film: Film) -> Tensor:
        """Samples that each pixel of the picture holds ``(pixels,)`` int64."""
        counts = film.counts
        if self.counted and len(self.pilots):
            counts[self.plate.places] += self.plate.film.counts
        return counts

    def known(self, film: Film, picture: Tensor) -> KnownError | None:
        """What the picture, :meth:`picture` of the film, knows of its error."""
        if not len(self.pilots) or int(self.plate.film.counts.min()) == 0:
            return None
        again = None
        if self.third is not None:
            plate, suspects = self.third
            values = torch.stack(plate.film.streams()).cpu()
            assert plate.places is not None
            again = Again(plate.places.cpu(), suspects, values.mean(0), values.var(0) / len(values))
        first = self._first(film)
        return known_error(picture.cpu(), self.pilots, first, self._second(), self._spare(), self.counted, again)

    def looks(self, pixels: int) -> float:
        """Return what looking again takes, as a share of the samples of a picture of so many pixels."""
        return STREAMS * sum(again_counts(pixels, len(self.pilots))) / pixels if len(self.pilots) else 0.0

    def look_again(self, film: Film, agreed: Callable[[Tensor], Tensor] | None = None) -> list[tuple[Plate, int, int]]:
        """What is to be sampled for the picture to know its error better, once it is finished or may be.

        ``agreed`` makes whole numbers ``(n,)`` those of the first rank; None: there is but one process.
        """
        if not len(self.pilots):
            return []
        picture, first = self.picture(film).cpu(), self._first(film)
        suspects, doubtful = to_look_at(picture, self.pilots, first, self._second())
        if agreed is not None:
            suspects, doubtful = agreed(suspects), agreed(doubtful)
        places = torch.cat((suspects, doubtful)).to(film.sums.device)
        streams = Streams(self.plate.streams.first + self.plate.streams.count, STREAMS)
        plate = Plate(Film(len(places), 1, STREAMS, film.sums.device), {}, streams, places)
        self.third = plate, len(suspects)
        self.looked = float(film.counts.double().mean())
        samples = round(self.looked)
        return [(plate, 0, STREAMS * samples)]

    def alone(self, film: Film) -> KnownError | None:
        """RelMSE as the pilots alone tell it."""
        if not len(self.pilots):
            return None
        return pilots_alone(self.pilots, self._first(film), self._second(), self._spare(), self.counted)

    def _first(self, film: Film) -> Tensor:
        assert self.plate.places is not None
        return film.taken(self.plate.places).values().cpu()

    def _second(self) -> Tensor:
        return self.plate.film.values().cpu()

    def _spare(self) -> Tensor | None:
        """The variance of second values where it is not that of the first ones."""
        if self.counted:
            return None
        one, other = self.plate.film.streams()
        return ((one - other).square() / 4).cpu()


def second_values(wave: Wave, settings: Settings, device: torch.device) -> Twice:
    """Pilots of a render, nothing sampled yet."""
    film = settings.film
    pilots = pilots_of(settings.render.seed, (film.width, film.height), wave.crop)
    streams = Streams(wave.sampler.randomizations, 2 if settings.adaptive else 1)
    sums = Film(len(pilots), 1, streams.count, device)
    return Twice(pilots, Plate(sums, {}, streams, pilots.places.to(device)), not settings.adaptive)
