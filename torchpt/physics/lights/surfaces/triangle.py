"""Triangles, sampled by :mod:`torchpt.physics.lights.solid_angle`."""

from __future__ import annotations

from torch import Tensor

from torchpt.math.sampling import uniform_triangle
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.solid_angle import TRIANGLE
from torchpt.physics.lights.surface import Surface, SurfaceSample, flat_point

__all__ = ["Triangle"]


class Triangle(Surface):
    """A triangle."""

    name = "triangle"
    code = TRIANGLE
    area_factor = 0.5  # a triangle is half of the parallelogram of its edges

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample_area`."""
        uv = uniform_triangle(u)
        return SurfaceSample(p=flat_point(at.p0, at.e1, at.e2, uv), normal=at.normal, uv=uv)
