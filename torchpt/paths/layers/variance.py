"""How far off the picture may be."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.paths.layer import FilmLayer
from torchpt.physics.film import Film

__all__ = ["Variance"]


class Variance(FilmLayer):
    """The variance of the picture's mean, from the spread of its randomizations; infinite where there is only one."""

    name = "variance"
    channels = ("variance.R", "variance.G", "variance.B")
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """See :class:`FilmLayer`."""
        variance = film.variance()
        return torch.full_like(film.mean(), torch.inf) if variance is None else variance
