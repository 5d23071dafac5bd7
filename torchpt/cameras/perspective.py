"""The pinhole camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.cameras.base import Camera
from torchpt.math.vectors import normalize

__all__ = ["FOV_AXES", "Perspective"]

#: What ``fov`` spans: the film's width, height, its smaller or larger side, or its diagonal.
FOV_AXES = ("x", "y", "smaller", "larger", "diagonal")


@dataclass(frozen=True)
class Perspective(Camera):
    """A pinhole camera: all rays start at one point.

    Attributes:
        fov: full angle of view in degrees, a 0-d tensor.
        fov_axis: one of :data:`FOV_AXES`.
    """

    fov: Tensor
    fov_axis: str

    def half_width(self) -> Tensor:
        """Tangent of half the horizontal angle of view."""
        half = torch.tan(self.fov * (math.pi / 360.0))
        w, h = self.film[0], self.film[1]
        if self.fov_axis == "x":
            return half
        if self.fov_axis == "diagonal":
            return half * (w / (w * w + h * h).sqrt())
        if self.fov_axis == "y":
            return half * (w / h)
        other = h < w if self.fov_axis == "smaller" else h > w
        return torch.where(other, half * (w / h), half)

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """How far ``right`` and ``up`` a ray through the film goes for each unit of depth, each ``(N,)``."""
        right, up = self.place(x, y)
        half = self.half_width()
        return right * half, up * half

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`; one origin."""
        right, up, ahead = self.axes()
        across, along = self.slopes(x, y)
        return self.origin(), normalize(ahead + up * along + right * across)

    def pixel(self) -> Tensor:
        """See :meth:`Camera.pixel`."""
        spread = self.half_width() * (2.0 / self.film[0])
        return torch.cat((self.origin()[:, 0], torch.stack((torch.ones_like(spread), spread))))
