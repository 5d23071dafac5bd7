"""Cones: the side, and a disk as a cap."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.shapes.base import BOTTOM, UPRIGHT, Matrix, Place, Shape, Size, Surface, placed
from torchpt.physics.shapes.quadrics import Form, Quadric, ring
from torchpt.spec import Flag, Refused

__all__ = ["Cone"]


class Cone(Shape, Quadric):
    """An analytic cone with its axis along y."""

    # The side in object space: x^2 + y^2 = (1 - z)^2, 0 <= z <= 1; slant height sqrt(2).
    name = "cone"
    form = Form(bend=-1.0, level=0.0, shift=1.0)
    area = math.sqrt(2.0) * math.pi
    parameters: ClassVar = {
        "apex": Place((0.0, 0.0, 0.0), doc="the apex, before the transform"),
        "height": Size(
            -1.0,
            low=None,
            length=True,
            words="a finite number other than 0",
            doc="from the apex to the base along y; negative: the base lies below the apex",
        ),
        "slope": Size(
            1.0,
            above=0.0,
            doc="radius over distance from the apex along the axis: the radius of the base is slope |height|",
        ),
        "capped": Flag(True, doc="whether a disk that faces outward closes the base"),
    }

    @classmethod
    def check(cls, values: Mapping[str, Any], given: frozenset[str]) -> None:
        """See :meth:`Shape.check`."""
        if values["height"] == 0:
            raise Refused("a finite number other than 0", values["height"], ("height",))

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Any:
        """See :meth:`Shape.own`."""
        height, slope = values["height"], values["slope"]
        # In object space the apex is at z = 1. Where the base lies above it, half a turn about x puts the cone on its apex.
        turn = UPRIGHT if height < 0 else UPRIGHT * [[1.0], [-1.0], [-1.0]]
        (x, y, z), length = values["apex"], abs(height)
        return placed((x, y + height, z), (slope * length, slope * length, length), turn)

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :meth:`Shape.surfaces`."""
        if not values["capped"]:
            return [Surface("quadric", quadric=cls)]
        side = Surface("quadric", label="side", quadric=cls)
        return [side, Surface("disk", label="bottom", local=BOTTOM)]

    @classmethod
    def place(cls, u: Tensor, v: Tensor) -> Tensor:
        """See :meth:`Quadric.place`."""
        around, height = ring(u), v.clamp(0.0, 1.0)
        radius = 1.0 - height
        return torch.stack((around[0] * radius, around[1] * radius, height))

    @classmethod
    def normal(cls, q: Tensor) -> Tensor:
        """See :meth:`Quadric.normal`. The length is ``sqrt(2)``, but 1 at the apex."""
        radius = (1.0 - q[2]).detach()
        below = radius > 0  # the apex
        scale = 1.0 / torch.where(below, radius, 1.0)
        return torch.stack((q[0] * scale, q[1] * scale, torch.where(below, 1.0 - q[2], 1.0) * scale))

    @classmethod
    def climb(cls, q: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Quadric.climb`."""
        one = torch.ones_like(radius)
        return -one, one

    @classmethod
    def sample(cls, u: Tensor) -> Tensor:
        """See :meth:`Quadric.sample`."""
        phi = (2.0 * math.pi) * u[0]
        # The area within a distance of the apex grows with the square of that distance.
        radius = u[1].sqrt()
        return torch.stack((radius * torch.cos(phi), radius * torch.sin(phi), 1.0 - radius))

    @classmethod
    def box(cls, e1: Tensor, e2: Tensor, e3: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Quadric.box`; the side is the hull of an ellipse and the apex."""
        extent = (e1.square() + e2.square()).sqrt()
        return torch.minimum(-extent, e3), torch.maximum(extent, e3)
