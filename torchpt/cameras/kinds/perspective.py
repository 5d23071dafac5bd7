"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchpt.cameras.pinhole import Pinhole
from torchpt.math.vectors import normalize

__all__ = ["Perspective"]


@dataclass(frozen=True, kw_only=True)
class Perspective(Pinhole):
    """A pinhole camera: all rays start at one point."""

    name = "perspective"

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`; one origin."""
        right, up, ahead = self.axes()
        across, along = self.slopes(x, y)
        return self.origin(), normalize(ahead + up * along + right * across)
