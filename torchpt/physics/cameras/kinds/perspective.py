"""The pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import normalize
from torchpt.physics.cameras.pinhole import Pinhole

__all__ = ["Perspective"]


@dataclass(frozen=True, kw_only=True)
class Perspective(Pinhole):
    """A pinhole camera: all rays start at one point."""

    name = "perspective"
    projects: ClassVar[bool] = True

    def rays(self, x: Tensor, y: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """See :meth:`Camera.rays`; all rays share one origin."""
        right, up, ahead = self.axes()
        across, along = self.slopes(x, y)
        return self.origin(), normalize(ahead + up * along + right * across)

    def project(self, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Camera.project`."""
        x, y, depth, _ = self.project_homogeneous(offset)  # x and y times the depth
        # Pixels per unit of slope, squared; the solid angle of an area on a plane falls with the third power of the depth.
        scale = (0.5 * self.film[0] / self.half_width()) ** 2 / depth.abs() ** 3
        scale = scale * torch.linalg.det(self.covectors()).abs()  # 1 for orthogonal axes
        return x / depth, y / depth, scale if self.pixel_aspect is None else scale * self.pixel_aspect
