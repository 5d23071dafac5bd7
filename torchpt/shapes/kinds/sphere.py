"""Spheres, which uneven transforms make ellipsoids of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from torchpt.math.transforms import similarity_scale
from torchpt.shapes.base import Matrix, Place, Shape, Size, Surface, placed

__all__ = ["Sphere"]


class Sphere(Shape):
    """An analytic sphere; under an uneven transform an ellipsoid."""

    name = "sphere"
    parameters: ClassVar = {
        "center": Place((0.0, 0.0, 0.0), doc="its middle, before the transform"),
        "radius": Size(1.0, above=0.0, length=True, doc="before the transform"),
    }

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Matrix:
        """See :class:`Shape`; its surface is the unit sphere."""
        radius = values["radius"]
        return placed(values["center"], (radius, radius, radius), np.eye(3))

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :class:`Shape`."""
        if similarity_scale(pose) is not None:
            return [Surface("sphere")]
        return [Surface("quadric", quadric="ellipsoid")]
