"""Quadrics under affine maps, such as ellipsoids and the sides of cylinders: see :mod:`torchpt.physics.shapes.quadrics`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import affine, dot
from torchpt.physics.shapes import quadrics
from torchpt.physics.shapes.geometry import Interaction, Quadrics
from torchpt.physics.shapes.primitive import Corners, FixedPoints, HitPoints, LanePrimitives, Primitive, Rays
from torchpt.physics.world import World

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = ["Quadric"]


class Quadric(Primitive):
    """A quadric; ``p0``, ``e1`` and ``e2`` of its map take the places of the corners ``p0 p1 p2`` of flat primitives."""

    name = "quadric"
    flat = False
    has_own_uv = True  # texture coordinates are computed here, not interpolated

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :meth:`Primitive.corners`."""
        linear, move = pose.split((3, 1), 1)
        x, y = linear[:, 0:1], linear[:, 1:2]
        frame = torch.cat((move, x, y, linear[:, 2:3]))
        return Corners(p0=move.to(dtype), p1=x.to(dtype), p2=y.to(dtype), frame=frame)

    @classmethod
    def hit_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> HitPoints:
        """See :meth:`Primitive.hit_points`."""
        table = quadrics.rows(world, primitives.prim)
        own = _object_point(table, rays, is_kind)
        if rays.follow_ray:
            moved = quadrics.follow_ray(table, primitives.p0, primitives.e1, rays.o, rays.d, rays.hit.t, own)
            own = torch.where(is_kind, moved, own)
        ng = quadrics.outward(table, own)
        # The rounding bound at the point, by the normal and the magnitudes of coordinates, not of the whole primitive: a
        # needle is far thinner than it is long.
        bound = dot(ng.detach().abs(), table.coordinate_bound)
        return HitPoints(p=_point(table, primitives, own), ng=ng, bound=bound, own=own)

    @classmethod
    def fixed_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> FixedPoints:
        """See :meth:`Primitive.fixed_points`; points stay fixed in object space."""
        table = quadrics.rows(world, primitives.prim)
        own = _object_point(table, rays, is_kind)
        # Along the normal, as long as the map scales area.
        area = quadrics.direction(table, quadrics.normal(table, own))
        return FixedPoints(p=_point(table, primitives, own), area=area)

    @classmethod
    def tangents(
        cls, world: World, primitives: LanePrimitives, at: Interaction, is_kind: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :meth:`Primitive.tangents`."""
        assert at.own is not None
        tangent = quadrics.tangent(primitives.e1, primitives.e2, at.own)
        if at.bitangent is None:
            return tangent, None
        return tangent, quadrics.bitangent(quadrics.rows(world, at.prim), primitives.e1, primitives.e2, at.own)

    @classmethod
    def uv(cls, world: World, at: Interaction) -> Tensor | None:
        """See :meth:`Primitive.uv`."""
        if at.own is None:  # points on lights of other kinds
            return None
        return quadrics.surface_uv(quadrics.rows(world, at.prim), at.own)


def _object_point(table: Quadrics, rays: Rays, is_kind: Tensor) -> Tensor:
    """Return hit points ``(3, N)`` in object space."""
    return quadrics.place(table, torch.where(is_kind, rays.hit.u, 0.0), torch.where(is_kind, rays.hit.v, 0.0))


def _point(table: Quadrics, primitives: LanePrimitives, own: Tensor) -> Tensor:
    """Return points ``(3, N)`` in the world for those of object space, ``own (3, N)``."""
    return affine(primitives.p0 + primitives.e1 * own[0], primitives.e2, own[1], table.e3, own[2])
