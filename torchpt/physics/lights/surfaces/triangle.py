"""Triangles, sampled by :mod:`torchpt.physics.lights.solid_angle`."""

from __future__ import annotations

from torchpt.physics.lights.solid_angle import TRIANGLE
from torchpt.physics.lights.surface import Surface

__all__ = ["Triangle"]


class Triangle(Surface):
    """A triangle."""

    name = "triangle"
    code = TRIANGLE
    share = 0.5
