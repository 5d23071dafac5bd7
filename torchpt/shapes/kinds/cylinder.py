"""Cylinders: a side, and two disks that close it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from torchpt.shapes.base import BOTTOM, TOP, UPRIGHT, Matrix, Place, Shape, Size, Surface, placed
from torchpt.spec import Flag

__all__ = ["Cylinder"]


class Cylinder(Shape):
    """An analytic cylinder about an axis along y."""

    name = "cylinder"
    parameters: ClassVar = {
        "center": Place((0.0, 0.0, 0.0), doc="its middle, half-way up, before the transform"),
        "radius": Size(1.0, above=0.0, length=True, doc="before the transform"),
        "height": Size(1.0, above=0.0, length=True, doc="along y, before the transform"),
        "capped": Flag(True, doc="closed by two disks that face outward"),
    }

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Matrix:
        """See :class:`Shape`; its side is ``x^2 + y^2 = 1, 0 <= z <= 1``."""
        radius, height = values["radius"], values["height"]
        bottom = np.subtract(values["center"], (0.0, 0.5 * height, 0.0))
        return placed(bottom, (radius, radius, height), UPRIGHT)

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :class:`Shape`."""
        if not values["capped"]:
            return [Surface("quadric", quadric="cylinder")]
        side = Surface("quadric", "side", quadric="cylinder")
        return [side, Surface("disk", "bottom", BOTTOM), Surface("disk", "top", TOP)]
