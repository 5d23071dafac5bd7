"""Rectangles and parallelograms, sampled by :mod:`torchpt.physics.lights.solid_angle`."""

from __future__ import annotations

from torch import Tensor

from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.solid_angle import RECTANGLE
from torchpt.physics.lights.surface import Surface, SurfaceSample, flat_point

__all__ = ["Rectangle"]


class Rectangle(Surface):
    """A parallelogram."""

    name = "rectangle"
    code = RECTANGLE

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample_area`."""
        return SurfaceSample(p=flat_point(at.p0, at.e1, at.e2, u), normal=at.normal, uv=u)
