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

    def connect(self, p: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :meth:`Camera.connect`."""
        x, y, depth, _ = self.project_homogeneous(p - self.origin())
        ahead = depth > 0
        depth = torch.where(ahead, depth, 1.0)
        return self.origin().expand_as(p), x / depth, y / depth, ahead

    def project(self, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See :meth:`Camera.project`."""
        x, y, depth, _ = self.project_homogeneous(offset)  # x and y times the depth
        return x / depth, y / depth, self.area_scale(depth)
