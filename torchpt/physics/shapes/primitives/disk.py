"""Disks and, under affine maps, ellipses. As in Mitsuba ``u`` is the distance from the centre, ``v`` the azimuth over 2 pi."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.shapes.primitive import Corners, LanePrimitives, Primitive
from torchpt.physics.shapes.primitives._affine import axes_of
from torchpt.physics.shapes.quadrics import polar
from torchpt.physics.world import World

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = ["Disk"]


class Disk(Primitive):
    """An ellipse about its centre ``p0``."""

    name = "disk"
    has_own_uv = True  # texture coordinates are computed here, not interpolated

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :meth:`Primitive.corners`."""
        move, x, y, mirrored = axes_of(pose)
        p1, p2 = move + x, move + y
        return Corners(p0=move.to(dtype), p1=p1.to(dtype), p2=p2.to(dtype), mirrored=mirrored)

    @classmethod
    def tangents(
        cls, world: World, primitives: LanePrimitives, at: Interaction, is_kind: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :meth:`Primitive.tangents`; ``u`` grows outward, ``v`` around the centre."""
        u, v, e1, e2 = at.u, at.v, primitives.e1, primitives.e2
        away = torch.addcmul(e1 * u, e2, v)
        square = torch.where(is_kind, u * u + v * v, 1.0)
        off_centre = square > 0
        tangent = torch.where(off_centre, away / torch.where(off_centre, square, 1.0).sqrt(), e1)
        if at.bitangent is None:
            return tangent, None
        around = torch.addcmul(e2 * u, e1, v, value=-1) * (2.0 * math.pi)
        if world.geometry.mirrored is not None:
            around = torch.where(take(world.geometry.mirrored, at.prim), -around, around)
        return tangent, around

    @classmethod
    def uv(cls, world: World, at: Interaction) -> Tensor | None:
        """See :meth:`Primitive.uv`."""
        x, y = at.u, at.v
        if world.geometry.mirrored is not None:
            turned = take(world.geometry.mirrored, at.prim)
            x, y = torch.where(turned, y, x), torch.where(turned, x, y)
        return torch.stack(polar(x, y))
