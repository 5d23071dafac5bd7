"""Cones: a side, and a disk that closes it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from torchpt.shapes.base import BOTTOM, UPRIGHT, Matrix, Place, Shape, Size, Surface, placed
from torchpt.spec import Flag, Refused

__all__ = ["Cone"]


class Cone(Shape):
    """An analytic cone with its axis along y."""

    name = "cone"
    parameters: ClassVar = {
        "apex": Place((0.0, 0.0, 0.0), doc="its tip, before the transform"),
        "height": Size(
            -1.0,
            low=None,
            length=True,
            words="a finite number other than 0",
            doc="from the tip to the base along y: the base lies below the tip where it is negative",
        ),
        "slope": Size(
            1.0, above=0.0, doc="radius over distance from the tip, along the axis: the base's radius is slope |height|"
        ),
        "capped": Flag(True, doc="closed by a disk that faces outward"),
    }

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :class:`Shape`."""
        if values["height"] == 0:
            raise Refused("a finite number other than 0", values["height"], ("height",))

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Matrix:
        """See :class:`Shape`; its side is ``x^2 + y^2 = (1 - z)^2, 0 <= z <= 1``."""
        height, slope = values["height"], values["slope"]
        turn = UPRIGHT if height < 0 else UPRIGHT * [[1.0], [-1.0], [-1.0]]
        base, length = np.add(values["apex"], (0.0, height, 0.0)), abs(height)
        return placed(base, (slope * length, slope * length, length), turn)

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :class:`Shape`."""
        if not values["capped"]:
            return [Surface("quadric", quadric="cone")]
        return [Surface("quadric", "side", quadric="cone"), Surface("disk", "bottom", BOTTOM)]
