"""The orthographic camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.physics.cameras.base import Camera
from torchpt.spec import Moves, Scalar

__all__ = ["Orthographic"]


@dataclass(frozen=True, kw_only=True)
class Orthographic(Camera):
    """A camera with parallel rays, which start on the plane through its origin: nothing behind it is visible.

    Attributes:
        width: width of the film in world units, a 0-d tensor.
    """

    name = "orthographic"
    parameters: ClassVar = {
        "width": Scalar(2.0, above=0.0, length=True, moves=Moves.SURFACES, doc="width of the film in the scene"),
    }
    parallel: ClassVar[bool] = True
    reaches: ClassVar[tuple[str, ...]] = ("width",)
    sized_by: ClassVar[str] = "an orthographic camera is sized by width"

    width: Tensor

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`."""
        right, up, ahead = self.axes()
        across, along = self.place(x, y)  # right and up, in half widths of the film
        half = 0.5 * self.width
        o = self.origin() + up * (along * half) + right * (across * half)
        return o, ahead.expand_as(o).clone()

    def connect(self, p: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :meth:`Camera.connect`."""
        x, y, _, depth = self.film_of(p)
        _, _, ahead = self.axes()
        return p - ahead * depth, x, y, depth > 0

    def film_density(self, d: Tensor) -> Tensor:
        """See :meth:`Camera.film_density`."""
        side = self.film[0] / self.width  # pixels per unit of length
        return (side * side).expand_as(d[0])

    def film_of(self, p: Tensor, u: Tensor | None = None) -> Tensor:
        """See :meth:`Camera.film_of`."""
        right, up, depth = self.covectors() @ (p - self.origin())  # components along the axes of the picture
        width, height = self.film[0], self.film[1]
        x = 0.5 * width + right * (width / self.width)
        y = 0.5 * height - up * (width / self.width)
        return torch.stack((x, y, torch.ones_like(x), depth))  # x h, y h, h and depth, with h = 1

    def pixel(self) -> Tensor:
        """See :meth:`Camera.pixel`."""
        spread = self.width / self.film[0]
        _, _, ahead = self.axes()
        return torch.cat((-ahead[:, 0], torch.stack((torch.zeros_like(spread), spread))))  # e, w = 0, spread
