"""Rectangles and parallelograms, sampled by :mod:`torchpt.physics.lights.solid_angle`."""

from __future__ import annotations

from torchpt.physics.lights.solid_angle import RECTANGLE
from torchpt.physics.lights.surface import Surface

__all__ = ["Rectangle"]


class Rectangle(Surface):
    """A parallelogram."""

    name = "rectangle"
    code = RECTANGLE
