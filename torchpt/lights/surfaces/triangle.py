"""Triangles, drawn by :mod:`torchpt.lights.solid_angle`."""

from __future__ import annotations

from torchpt.lights.solid_angle import TRIANGLE
from torchpt.lights.surface import Surface

__all__ = ["Triangle"]


class Triangle(Surface):
    """A triangle."""

    name = "triangle"
    code = TRIANGLE
    share = 0.5
