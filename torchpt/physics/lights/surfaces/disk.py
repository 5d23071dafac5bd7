"""Disks and ellipses, sampled by area."""

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
    area_factor = math.pi  # area of an ellipse over the product of its half axes, which `e1` and `e2` are

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample_area`."""
        uv = concentric_disk(u)
        return SurfaceSample(p=flat_point(at.p0, at.e1, at.e2, uv), normal=at.normal, uv=uv)
