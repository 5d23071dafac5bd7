"""How many samples pixels hold."""

from __future__ import annotations

from torch import Tensor

from torchpt.paths.layer import FilmLayer
from torchpt.physics.film import Film

__all__ = ["Samples"]


class Samples(FilmLayer):
    """How many samples of light the pixel is a mean of: `sampler.adaptive` says where; a pilot may hold twice as many."""

    name = "samples"
    channels = ("samples",)
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """See :class:`FilmLayer`."""
        return counts.double().reshape(film.height, film.width, 1)
