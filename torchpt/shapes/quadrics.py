"""Quadrics under affine maps: points, normals, tangents, uv, area and sampling, in the surface's own space.

Own spaces (:data:`torchpt.records.QUADRICS`): the unit sphere; the cylinder ``x^2 + y^2 = 1`` and the cone
``x^2 + y^2 = (1 - z)^2``, both for ``0 <= z <= 1`` and without caps. A primitive maps them by ``p = p0 + x e1 + y e2 + z e3``;
normals follow by the cofactor matrix, which needs no inverse and keeps the outside outside when the map mirrors.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.math.angles import azimuth
from torchpt.math.vectors import affine, dot, normalize
from torchpt.math.warps import uniform_sphere
from torchpt.records import QUADRICS, Quadrics, World
from torchpt.records import rows as columns

__all__ = [
    "AREAS",
    "bitangent",
    "direction",
    "normal",
    "outward",
    "place",
    "rows",
    "sample",
    "slide",
    "surface_uv",
    "tangent",
]

#: Areas in their own space, in the order of ``QUADRICS``; a cone's side is ``sqrt(2)`` long.
AREAS = (4.0 * math.pi, 2.0 * math.pi, math.sqrt(2.0) * math.pi)
_ELLIPSOID, _CYLINDER, _CONE = range(len(QUADRICS))


def rows(world: World, prim: Tensor) -> Quadrics:
    """The columns ``(., N)`` of primitives ``prim (N,)``; any where one is no quadric."""
    assert world.geometry.quadrics is not None
    index = (prim - world.geometry.ends[3]).clamp_min(0)
    return columns(world.geometry.quadrics, index)


def place(code: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Points ``(3, N)`` in their own space from the ``u, v (N,)`` of a search (:func:`torchpt.accel.leaf.quadric`)."""
    across, sign = u.abs(), torch.copysign(torch.ones_like(u), u)
    ring = normalize(torch.stack((1.0 - across, sign * torch.minimum(across, 2.0 - across), torch.zeros_like(u))))
    height = v.clamp(0.0, 1.0)
    radius = torch.where(code == _CONE, 1.0 - height, 1.0)
    z = 1.0 - u.abs() - v.abs()
    x = torch.where(z < 0, torch.copysign(1.0 - v.abs(), u), u)
    y = torch.where(z < 0, torch.copysign(1.0 - u.abs(), v), v)
    ball = normalize(torch.stack((x, y, z)))
    return torch.where(code == _ELLIPSOID, ball, torch.stack((ring[0] * radius, ring[1] * radius, height)))


def normal(code: Tensor, q: Tensor) -> Tensor:
    """Outward normals ``(3, N)`` at points of their own space, unit but for a cone's, which are ``sqrt(2)`` long.

    At the apex of a cone: along its axis.
    """
    radius = (1.0 - q[2]).detach()
    cone = (code == _CONE) & (radius > 0)
    share = 1.0 / torch.where(cone, radius, 1.0)
    z = torch.where(code == _ELLIPSOID, q[2], torch.where(code == _CONE, torch.where(cone, 1.0 - q[2], 1.0), 0.0))
    return torch.stack((q[0] * share, q[1] * share, z * share))


def direction(table: Quadrics, n: Tensor) -> Tensor:
    """Own normals ``(3, N)`` as front-facing directions of the world, not of unit length."""
    return affine(table.n1 * n[0], table.n2, n[1], table.n3, n[2])


def outward(table: Quadrics, q: Tensor) -> Tensor:
    """Unit normals ``(3, N)`` of the world, on the front."""
    return normalize(direction(table, normal(table.code, q)))


def tangent(e1: Tensor, e2: Tensor, q: Tensor) -> Tensor:
    """Derivatives ``(3, N)`` of the world's point with respect to ``u``, the azimuth in turns."""
    return (e2 * q[0] - e1 * q[1]) * (2.0 * math.pi)


def bitangent(table: Quadrics, e1: Tensor, e2: Tensor, q: Tensor) -> Tensor:
    """Derivatives ``(3, N)`` of the world's point with respect to ``v``: upward, on an ellipsoid from its pole down."""
    ball, cone = table.code == _ELLIPSOID, table.code == _CONE
    across = (q[0] * q[0] + q[1] * q[1]).detach()
    radius = torch.where(across > 0, across, 1.0).sqrt()
    x, y = q[0] / radius, q[1] / radius
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    inward = torch.where(ball, math.pi * q[2], torch.where(cone, -one, zero))
    upward = torch.where(ball, -math.pi * radius, one)
    return affine(e1 * (inward * x), e2, inward * y, table.e3, upward)


def surface_uv(code: Tensor, q: Tensor) -> Tensor:
    """Texture coordinates ``(2, N)``: azimuth about z over 2 pi, and z (on an ellipsoid: the angle from z over pi)."""
    u = azimuth(q[0], q[1]) * (0.5 / math.pi)
    square = q[0] * q[0] + q[1] * q[1]
    side = torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)
    return torch.stack((u, torch.where(code == _ELLIPSOID, azimuth(q[2], side) * (1.0 / math.pi), q[2])))


def slide(table: Quadrics, p0: Tensor, e1: Tensor, o: Tensor, d: Tensor, t: Tensor, q: Tensor) -> Tensor:
    """The points ``q (3, N)`` with the derivative of where the ray ``o + t d`` meets the surface, in all arguments but ``t``.

    One Newton step on the surface's equation, whose slope is a constant of it. In float64 it is the value too, finer than the
    search's float32; else the value stays ``q``, which knows nothing of how far away the ray began.
    """
    det = dot(e1, table.n1)
    inverse = 1.0 / torch.where(det == 0, 1.0, det)

    def own(x: Tensor) -> Tensor:
        return torch.stack((dot(table.n1, x), dot(table.n2, x), dot(table.n3, x))) * inverse

    f, e = own(o - p0), own(d)
    at = f + e * t.detach()
    ball, cone = table.code == _ELLIPSOID, table.code == _CONE
    z = torch.where(ball, at[2], torch.where(cone, at[2] - 1.0, 0.0))
    bend = torch.where(cone, -1.0, 1.0).to(z.dtype)
    level = torch.where(cone, 0.0, 1.0).to(z.dtype)
    value = at[0] * at[0] + at[1] * at[1] + bend * z * z - level
    slope = (2.0 * (at[0] * e[0] + at[1] * e[1] + bend * z * e[2])).detach()
    moved = at - e.detach() * (value / torch.where(slope == 0, 1.0, slope))
    return moved if q.dtype == torch.float64 else q + (moved - moved.detach())


def sample(code: Tensor, u: Tensor) -> Tensor:
    """Points ``(3, N)`` uniform by area in their own space, from ``u (2, N)`` in [0, 1)."""
    phi = (2.0 * math.pi) * u[0]
    # The area between the apex and a distance from it grows with the square of that distance.
    radius = torch.where(code == _CONE, u[1].sqrt(), 1.0)
    z = torch.where(code == _CONE, 1.0 - radius, u[1])
    side = torch.stack((radius * torch.cos(phi), radius * torch.sin(phi), z))
    return torch.where(code == _ELLIPSOID, uniform_sphere(u), side)
