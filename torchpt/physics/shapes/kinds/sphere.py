"""Spheres; non-uniform scales turn them into ellipsoids."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from torch import Tensor

from torchpt.math.sampling import uniform_sphere
from torchpt.math.transforms import similarity_scale
from torchpt.math.vectors import azimuth
from torchpt.physics.shapes.base import Matrix, Place, Shape, Size, Surface, placed
from torchpt.physics.shapes.quadrics import Form, Quadric, octahedral

__all__ = ["Ellipsoid", "Sphere"]


class Ellipsoid(Quadric):
    """The unit sphere."""

    name = "ellipsoid"
    form = Form(bend=1.0, level=1.0, low=-math.inf, high=math.inf, around=True)
    area = 4.0 * math.pi

    @classmethod
    def place(cls, u: Tensor, v: Tensor) -> Tensor:
        """See :meth:`Quadric.place`."""
        return octahedral(u, v)

    @classmethod
    def normal(cls, q: Tensor) -> Tensor:
        """See :meth:`Quadric.normal`."""
        return q

    @classmethod
    def climb(cls, q: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Quadric.climb`; ``v`` grows from the pole +z to -z."""
        return math.pi * q[2], -math.pi * radius

    @classmethod
    def v(cls, q: Tensor, radius: Tensor) -> Tensor:
        """Return the angle from +z over pi ``(N,)``."""
        return azimuth(q[2], radius) * (1.0 / math.pi)

    @classmethod
    def sample(cls, u: Tensor) -> Tensor:
        """See :meth:`Quadric.sample`."""
        return uniform_sphere(u)

    @classmethod
    def box(cls, e1: Tensor, e2: Tensor, e3: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Quadric.box`."""
        extent = (e1.square() + e2.square() + e3.square()).sqrt()
        return -extent, extent


class Sphere(Shape):
    """An analytic sphere; an ellipsoid under a transform that does not preserve angles."""

    name = "sphere"
    parameters: ClassVar = {
        "center": Place((0.0, 0.0, 0.0), doc="centre before the transform"),
        "radius": Size(1.0, above=0.0, length=True, doc="radius before the transform"),
    }

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Any:
        """See :meth:`Shape.own`; the primitive is the unit sphere."""
        radius = values["radius"]
        return placed(values["center"], (radius, radius, radius), np.eye(3))

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :meth:`Shape.surfaces`."""
        if similarity_scale(pose) is not None:
            return [Surface("sphere")]
        return [Surface("quadric", quadric=Ellipsoid)]
