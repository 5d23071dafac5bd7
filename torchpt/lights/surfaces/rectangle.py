"""Rectangles and parallelograms, drawn by :mod:`torchpt.lights.solid_angle`."""

from __future__ import annotations

from torchpt.lights.solid_angle import RECTANGLE
from torchpt.lights.surface import Surface

__all__ = ["Rectangle"]


class Rectangle(Surface):
    """A parallelogram."""

    name = "rectangle"
    code = RECTANGLE
