"""Rectangles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchpt.physics.shapes.base import Matrix, Shape, Surface

__all__ = ["Rectangle"]


class Rectangle(Shape):
    """The square ``[-1, 1]^2`` in the xy plane with normal +z, then transformed."""

    name = "rectangle"

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :meth:`Shape.surfaces`."""
        return [Surface("rectangle")]
