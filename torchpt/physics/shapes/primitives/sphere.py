"""Spheres: ``p0`` is the centre, ``e1`` begins with the radius. Texture coordinates as in Mitsuba: azimuth, angle from z."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import azimuth, cross, dot, normalize, take
from torchpt.physics.shapes.geometry import KINDS, Interaction
from torchpt.physics.shapes.primitive import Corners, FixedPoints, HitPoints, LanePrimitives, Primitive, Rays, Triple
from torchpt.physics.shapes.quadrics import polar, resolvable_slope
from torchpt.physics.world import World

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = ["Sphere", "axes"]

_NUMBER = KINDS.index("sphere")


class Sphere(Primitive):
    """A sphere. Masks ``is_kind (N,)`` are True in lanes whose primitive is a sphere; results in other lanes are arbitrary."""

    name = "sphere"
    has_own_uv = True  # texture coordinates are computed here, not interpolated
    flat = False
    needs_similarity = True  # under a transform that is no similarity a sphere becomes a quadric

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :meth:`Primitive.corners`."""
        linear, move = pose.split((3, 1), 1)
        radius = torch.linalg.det(linear).abs() ** (1.0 / 3.0)  # the pose scales equally along all axes
        zero = torch.zeros_like(radius)
        # Of spheres `p1` becomes `e1` as it is, without `p0` subtracted.
        p1 = torch.stack((radius, zero, zero))[:, None]
        return Corners(p0=move.to(dtype), p1=p1.to(dtype), p2=torch.zeros_like(move).to(dtype))

    @classmethod
    def tangent_columns(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """Return the vector whose cross product with the normal is the tangent, and ``(pi r, 0, 0)`` for the bitangent."""
        linear = linear.to(corners.p0)
        radius, zero = corners.p1[0].abs(), torch.zeros_like(corners.p1[0])
        turned = -1.0 if part.flip else 1.0  # sign of the normal
        # -1 for a mirroring pose or for flipped normals: u then grows the other way round the axis.
        handed = torch.sign(torch.linalg.det(linear.detach().double())).to(corners.p0) * turned
        around = normalize(linear[:, 2:3]) * (2.0 * math.pi * radius * handed)
        return around, torch.stack((math.pi * radius * handed, zero, zero))

    @classmethod
    def hit_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> HitPoints:
        """See :meth:`Primitive.hit_points`."""
        assert world.geometry.flip is not None
        o, d, p0 = rays.o, rays.d, primitives.p0
        radius = torch.where(is_kind, primitives.e1[0], 1.0)  # 1 and 0: finite values, and so gradients, in other lanes
        t = _distance(o, d, p0, radius, rays.hit.t) if rays.follow_ray else rays.hit.t
        t = torch.where(is_kind, t, 0.0)
        away = o + d * t - p0
        if not rays.follow_ray:  # the point stays where it is on the sphere
            away = away.detach()
        outward = normalize(torch.where(is_kind, away, torch.ones_like(away)))
        return HitPoints(p=p0 + outward * radius, ng=outward * take(world.geometry.flip, primitives.prim))

    @classmethod
    def fixed_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> FixedPoints:
        """See :meth:`Primitive.fixed_points`; points keep their normal."""
        radius = torch.where(is_kind, primitives.e1[0], 1.0)
        outward = normalize((rays.o + rays.d * rays.hit.t - primitives.p0).detach())
        # A sphere is parametrized by the directions of its normals: a unit of solid angle has the area radius^2.
        return FixedPoints(p=primitives.p0 + outward * radius, area=outward * (radius * radius))

    @classmethod
    def tangents(
        cls, world: World, primitives: LanePrimitives, at: Interaction, is_kind: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See :meth:`Primitive.tangents`; ``u`` grows around the axis, ``v`` downward."""
        assert at.tangent is not None
        around = cross(at.tangent, at.ng)
        down = None if at.bitangent is None else cross(normalize(around), at.ng) * at.bitangent[0]
        return around, down

    @classmethod
    def uv(cls, world: World, at: Interaction) -> Tensor | None:
        """See :meth:`Primitive.uv`."""
        assert world.geometry.axes is not None
        # Ids of the spheres: first .. end - 1.
        first, end = world.geometry.ends[_NUMBER - 1], world.geometry.ends[_NUMBER]
        column = torch.minimum((at.prim - first).clamp_min(0), end - first - 1)  # in the axes, which only spheres have
        away = at.p - take(world.geometry.p0, at.prim)
        x, y, z = (dot(take(axis, column), away) for axis in world.geometry.axes)
        distance, u = polar(x, y)  # distance from the axis, and azimuth over 2 pi
        v = azimuth(z, distance) * (1.0 / math.pi)  # angle from z over pi
        return torch.stack((u, v))


def axes(poses: list[Tensor], dtype: torch.dtype) -> Triple:
    """Return unit axes x, y, z ``(3, S)`` of spheres with these poses ``(4, 4)``."""
    linear = [pose[:3, :3] for pose in poses]
    x, y, z = (normalize(torch.stack([m[:, k] for m in linear], 1).to(dtype)) for k in range(3))
    return x, y, z


def _distance(o: Tensor, d: Tensor, centre: Tensor, radius: Tensor, found: Tensor) -> Tensor:
    """Return the ray parameter of a hit that the search ``found``, with the derivative of the sphere's implicit equation."""
    t = found.detach()
    f = o + d * t - centre
    # One Newton step on |f|^2 = r^2 with a detached slope: it refines the value and gives the exact derivative.
    away, size = (o - centre).detach(), radius.detach()
    slope = resolvable_slope((2.0 * dot(f, d)).detach(), 2.0 * size, dot(away, away).sqrt() / size)
    return t - (dot(f, f) - radius * radius) / slope
