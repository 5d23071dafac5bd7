"""Triangles, sampled by :mod:`torchpt.physics.lights.solid_angle`."""

from __future__ import annotations

from torchpt.physics.lights.solid_angle import TRIANGLE
from torchpt.physics.lights.surface import Surface

__all__ = ["Triangle"]


class Triangle(Surface):
    """A triangle."""

    name = "triangle"
    code = TRIANGLE
    area_factor = 0.5  # a triangle is half of the parallelogram of its edges
