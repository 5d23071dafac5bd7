"""Adaptive sampling: rounds of samples where pilots say that the error is."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchpt.film import Film, Pilots
from torchpt.film.known_error import error_by_pilots
from torchpt.film.pilots import BLOCK
from torchpt.film.sharing import foreseen, shared_out
from torchpt.forward.twice import Twice
from torchpt.integrators.plate import Plate

__all__ = ["FIRST_ROUND", "Shares"]

#: Samples that every pixel takes before any is asked.
FIRST_ROUND = 16


class Shares:
    """Samples of the blocks of a picture.

    Args:
        pilots: of the picture.
        film: of the picture.
        agreed: makes whole numbers ``(n,)`` those of the first rank; None: there is but one process.
    """

    def __init__(self, pilots: Pilots, film: Film, agreed: Callable[[Tensor], Tensor] | None = None) -> None:
        self.pilots, self._agreed = pilots, agreed
        x, y = torch.arange(film.width) + pilots.corner[0], torch.arange(film.height) + pilots.corner[1]
        rows, columns = pilots.blocks
        #: Block of each pixel.
        self.block = ((y // BLOCK)[:, None] * columns + (x // BLOCK)[None]).reshape(-1)
        self.pixels = torch.bincount(self.block, minlength=rows * columns)
        self._parts: list[tuple[Film, Tensor, Film]] = []

    def spans(self, picture: Plate, twice: Twice, mean: float, last: bool) -> list[tuple[Plate, int, int]]:
        """What is to be sampled for the picture to have ``mean`` samples a pixel: plates of pixels with as many samples.

        ``last``: whether no round follows, see :func:`torchpt.film.sharing.shared_out`.
        """
        device = picture.film.sums.device
        counts = self._of_blocks(picture.film.counts.cpu())
        aims = shared_out(self._errors(twice), counts, self.pixels, mean, last)
        spans: list[tuple[Plate, int, int]] = []
        if self._agreed is not None:
            aims = self._agreed(aims)
        most = int(aims.max()) + 1
        kinds = (counts * most + aims)[aims > counts].unique().tolist()
        pilot_blocks = self.block[self.pilots.places]
        for have, aim in (divmod(kind, most) for kind in kinds):
            chosen = (counts == have) & (aims == aim)
            places = chosen[self.block].nonzero()[:, 0].to(device)
            spans.append((self._part(picture, places, places), have, aim - have))
            seconds = chosen[pilot_blocks].nonzero()[:, 0]
            if len(seconds):
                part = self._part(twice.plate, seconds.to(device), self.pilots.places[seconds].to(device))
                spans.append((part, have, aim - have))
        return spans

    def put_back(self) -> None:
        """Add what was sampled to the films that it is of."""
        for whole, places, part in self._parts:
            whole.put(places, part)
        self._parts.clear()

    def _part(self, plate: Plate, places: Tensor, pixels: Tensor) -> Plate:
        """Some pixels of a plate as a plate of their own."""
        films = {}
        for name, film in (("", plate.film), *plate.layers.items()):
            films[name] = film.taken(places)
            self._parts.append((film, places, films[name]))
        return Plate(films.pop(""), films, plate.streams, pixels)

    def _of_blocks(self, counts: Tensor) -> Tensor:
        """Samples of the pixels of each block, which are the same."""
        found = torch.zeros(len(self.pixels), dtype=torch.int64)
        found[self.block] = counts
        return found

    def _errors(self, twice: Twice) -> Tensor:
        """Relative variance of the pixels of each block, up to a factor: second values alone are asked."""
        a, b = (x.cpu() for x in twice.plate.film.streams())
        errors, known = a.new_zeros(self.pilots.blocks), torch.zeros(self.pilots.blocks, dtype=torch.bool)
        at = tuple(self.pilots.block)
        errors[at], known[at] = error_by_pilots(self.pilots, a, b), True
        return foreseen(errors, known).reshape(-1)
