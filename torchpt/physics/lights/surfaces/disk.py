"""Disks and ellipses, drawn by area."""

from __future__ import annotations

import math

from torch import Tensor

from torchpt.math.sampling import concentric_disk
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.surface import Surface, SurfaceSample, flat_point

__all__ = ["Disk"]


class Disk(Surface):
    """An ellipse."""

    name = "disk"
    share = math.pi

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor) -> SurfaceSample:
        """See :class:`Surface`."""
        uv = concentric_disk(u)
        return SurfaceSample(flat_point(at.p0, at.e1, at.e2, uv), at.normal, uv)
