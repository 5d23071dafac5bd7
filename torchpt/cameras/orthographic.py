"""The parallel projection."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.cameras.base import Camera

__all__ = ["Orthographic"]


@dataclass(frozen=True)
class Orthographic(Camera):
    """A camera of parallel rays, which start on the plane through its origin.

    Attributes:
        extent: what the film's width shows, in world units, a 0-d tensor.
    """

    extent: Tensor

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`."""
        right, up, ahead = self.axes()
        across, along = self.place(x, y)
        half = 0.5 * self.extent
        o = self.origin() + up * (along * half) + right * (across * half)
        return o, ahead.expand_as(o).clone()

    def pixel(self) -> Tensor:
        """See :meth:`Camera.pixel`."""
        spread = self.extent / self.film[0]
        return torch.cat((-self.axes()[2][:, 0], torch.stack((torch.zeros_like(spread), spread))))
