"""Cylinders: the side, and two disks as caps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.shapes.base import BOTTOM, TOP, UPRIGHT, Matrix, Place, Shape, Size, Surface, placed
from torchpt.physics.shapes.quadrics import Form, Quadric, ring
from torchpt.spec import Flag

__all__ = ["Cylinder"]


class Cylinder(Shape, Quadric):
    """An analytic cylinder about an axis along y."""

    # The side in object space: x^2 + y^2 = 1, 0 <= z <= 1.
    name = "cylinder"
    form = Form(bend=0.0, level=1.0)
    area = 2.0 * math.pi
    parameters: ClassVar = {
        "center": Place((0.0, 0.0, 0.0), doc="centre, half-way up the axis, before the transform"),
        "radius": Size(1.0, above=0.0, length=True, doc="radius before the transform"),
        "height": Size(1.0, above=0.0, length=True, doc="height along y, before the transform"),
        "capped": Flag(True, doc="whether two disks that face outward close the ends"),
    }

    @classmethod
    def own(cls, values: Mapping[str, Any]) -> Any:
        """See :meth:`Shape.own`."""
        radius, height = values["radius"], values["height"]
        x, y, z = values["center"]
        return placed((x, y - 0.5 * height, z), (radius, radius, height), UPRIGHT)

    @classmethod
    def surfaces(cls, values: Mapping[str, Any], pose: Matrix) -> list[Surface]:
        """See :meth:`Shape.surfaces`."""
        if not values["capped"]:
            return [Surface("quadric", quadric=cls)]
        side = Surface("quadric", label="side", quadric=cls)
        return [side, Surface("disk", label="bottom", local=BOTTOM), Surface("disk", label="top", local=TOP)]

    @classmethod
    def place(cls, u: Tensor, v: Tensor) -> Tensor:
        """See :meth:`Quadric.place`."""
        around = ring(u)
        return torch.stack((around[0], around[1], v.clamp(0.0, 1.0)))

    @classmethod
    def normal(cls, q: Tensor) -> Tensor:
        """See :meth:`Quadric.normal`."""
        return torch.stack((q[0], q[1], torch.zeros_like(q[2])))

    @classmethod
    def sample(cls, u: Tensor) -> Tensor:
        """See :meth:`Quadric.sample`."""
        phi = (2.0 * math.pi) * u[0]
        return torch.stack((torch.cos(phi), torch.sin(phi), u[1]))

    @classmethod
    def box(cls, e1: Tensor, e2: Tensor, e3: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Quadric.box`; the side is the hull of two ellipses."""
        extent = (e1.square() + e2.square()).sqrt()
        return torch.minimum(-extent, e3 - extent), torch.maximum(extent, e3 + extent)
