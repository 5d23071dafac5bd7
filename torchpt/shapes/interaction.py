"""The surface point under a hit, re-derived from ``prim, u, v`` with gradients.

The search is free of gradients. Here the point comes from the primitive's own corners, which is more accurate than
``o + t d`` and makes any search differentiable. Two parametrizations serve the derivative (the values are the same):

- a camera ray stays fixed in its pixel and the point slides along it: ``slide``;
- at later vertices the point stays fixed on its surface and the direction follows: :func:`reattach` (the material form of
  Zhang, Miller, Yan, Gkioulekas, Zhao, *Path-Space Differentiable Rendering*, 2020; its interior term).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import affine, cross, dot, normalize, take
from torchpt.records import Copies, Hit, Interaction, World, rows
from torchpt.shapes import quadrics

__all__ = ["OFFSET", "interact", "offset_origin", "reattach"]

#: Rays leave a surface ``OFFSET * LaneGeometry.bound`` off its plane. Re-deriving a point and evaluating its plane in the
#: search each round by less than ``4 * 2^-24 * 2 bound``; this is two and a half times their sum, and free of world units.
OFFSET = 2.0**-19


def _slide(o: Tensor, d: Tensor, p0: Tensor, e1: Tensor, e2: Tensor) -> tuple[Tensor, Tensor]:
    """``u, v`` of the ray with the primitive's plane (Moeller and Trumbore, 1997), differentiable in all arguments."""
    pvec = cross(d, e2)
    det = dot(e1, pvec)
    inverse = 1.0 / torch.where(det == 0, 1.0, det)
    tvec = o - p0
    return dot(tvec, pvec) * inverse, dot(d, cross(tvec, e1)) * inverse


@dataclass(frozen=True)
class _Place:
    """Where primitives lie: what interactions need of them before a point is chosen."""

    prim: Tensor  # (N,) below P
    p0: Tensor  # (3, N)
    e1: Tensor  # (3, N)
    e2: Tensor  # (3, N)
    copies: Copies | None  # columns (., N) where the scene has copies
    copied: Tensor | None  # (N,) bool: which are copies
    reach: Tensor | None  # (3, N) coordinate magnitudes that enter a point's sum, where the scene has copies

    def moved(self, w: Tensor) -> Tensor:
        """Vectors ``(3, N)`` of a mesh as those of its copy."""
        assert self.copies is not None
        return _linear(self.copies, w)

    def turned(self, n: Tensor) -> Tensor:
        """Unit normals ``(3, N)`` of a mesh as those of its copy."""
        assert self.copies is not None and self.copied is not None
        turned = affine(self.copies.nx * n[0], self.copies.ny, n[1], self.copies.nz, n[2])
        return torch.where(self.copied, normalize(turned), n)


def _linear(copies: Copies, w: Tensor) -> Tensor:
    return affine(copies.x * w[0], copies.y, w[1], copies.z, w[2])


def _placed(world: World, prim: Tensor) -> _Place:
    """Places of primitives by ids as the search gives them, none of them a miss."""
    if world.geometry.copies is None:
        return _Place(
            prim,
            take(world.geometry.p0, prim),
            take(world.geometry.e1, prim),
            take(world.geometry.e2, prim),
            None,
            None,
            None,
        )
    column = world.geometry.copy(prim)
    table = rows(world.geometry.copies, column)
    prim = prim - table.start + table.first
    p0, e1, e2 = take(world.geometry.p0, prim), take(world.geometry.e1, prim), take(world.geometry.e2, prim)
    size = (p0.abs() + e1.abs() + e2.abs()).detach()
    reach = affine(table.x.abs() * size[0], table.y.abs(), size[1], table.z.abs(), size[2]) + table.move.abs()
    p0, e1, e2 = _linear(table, p0) + table.move, _linear(table, e1), _linear(table, e2)
    return _Place(prim, p0, e1, e2, table, column > 0, reach.detach())


def interact(world: World, o: Tensor, d: Tensor, hit: Hit, slide: bool = False) -> Interaction:
    """Surface points of hits ``(N,)``, none of them a miss.

    Args:
        world: the scene's tensors.
        o: ray origins ``(3, N)``.
        d: ray directions ``(3, N)``.
        hit: from the search.
        slide: re-intersect the ray with the plane, so that the point follows ``o``, ``d`` and the geometry.
    """
    place = _placed(world, hit.prim)
    prim, p0, e1, e2, u, v = place.prim, place.p0, place.e1, place.e2, hit.u, hit.v
    ball, curved = _spheres(world, prim), _quadrics(world, prim)
    if slide:
        u, v = _slide(o, d, p0, e1, e2)
    for other in (ball, curved):
        if other is not None:
            u, v = torch.where(other, 0.0, u), torch.where(other, 0.0, v)
    p = affine(p0, e1, u, e2, v)
    ng = take(world.geometry.normal, prim) if place.copies is None else place.turned(take(world.geometry.normal, prim))
    if ball is not None:
        assert world.geometry.flip is not None
        radius = torch.where(ball, e1[0], 1.0)
        t = _sphere_distance(o, d, p0, radius, hit.t) if slide else hit.t
        t = torch.where(ball, t, 0.0)
        outward = normalize(torch.where(ball, o + d * t - p0, torch.ones_like(p)))
        p = torch.where(ball, p0 + outward * radius, p)
        ng = torch.where(ball, outward * take(world.geometry.flip, prim), ng)
    bound = None
    if place.copied is not None and place.reach is not None:
        bound = torch.where(place.copied, dot(ng.detach().abs(), place.reach), take(world.geometry.bound, prim))
    own = None
    if curved is not None:
        table = quadrics.rows(world, prim)
        own = quadrics.place(table.code, torch.where(curved, hit.u, 0.0), torch.where(curved, hit.v, 0.0))
        if slide:
            own = torch.where(curved, quadrics.slide(table, p0, e1, o, d, hit.t, own), own)
        p = torch.where(curved, affine(p0 + e1 * own[0], e2, own[1], table.e3, own[2]), p)
        ng = torch.where(curved, quadrics.outward(table, own), ng)
        # At the point itself: a needle is far thinner than it is long.
        other = take(world.geometry.bound, prim) if bound is None else bound
        bound = torch.where(curved, dot(ng.detach().abs(), table.reach), other)
    ns = ng
    if world.geometry.normals is not None:
        corners = [take(n, prim) for n in world.geometry.normals]
        if place.copies is not None:
            corners = [place.turned(n) for n in corners]
        ns = normalize(affine(corners[0] * (1.0 - u - v), corners[1], u, corners[2], v))
        if any(world.geometry.counts[1:]):
            ns = torch.where(prim < world.geometry.ends[0], ns, ng)
    tangent, bitangent = _tangents(world, prim, u, v, e1, e2, ng)
    if tangent is not None and place.copied is not None:
        tangent = torch.where(place.copied, place.moved(tangent), tangent)
        bitangent = None if bitangent is None else torch.where(place.copied, place.moved(bitangent), bitangent)
    if tangent is not None and curved is not None and own is not None:
        tangent = torch.where(curved, quadrics.tangent(e1, e2, own), tangent)
        if bitangent is not None:
            bitangent = torch.where(curved, quadrics.bitangent(quadrics.rows(world, prim), e1, e2, own), bitangent)
    return Interaction(p, ng, ns, tangent, bitangent, prim, world.geometry.slot(hit.prim), bound, u, v, own)


def _spheres(world: World, prim: Tensor) -> Tensor | None:
    """Which of the primitives are spheres; None where the scene has none."""
    if not world.geometry.counts[3]:
        return None
    found = prim >= world.geometry.ends[2]
    return found if not world.geometry.counts[4] else found & (prim < world.geometry.ends[3])


def _quadrics(world: World, prim: Tensor) -> Tensor | None:
    """Which of the primitives are quadrics; None where the scene has none."""
    return prim >= world.geometry.ends[3] if world.geometry.counts[4] else None


def _tangents(
    world: World, prim: Tensor, u: Tensor, v: Tensor, e1: Tensor, e2: Tensor, ng: Tensor
) -> tuple[Tensor | None, Tensor | None]:
    """How points move with their texture coordinates: on a disk outward and around, on a sphere around and down (Mitsuba)."""
    if world.geometry.tangents is None:
        return None, None
    tangent = take(world.geometry.tangents, prim)
    bitangent = None if world.geometry.bitangents is None else take(world.geometry.bitangents, prim)
    ball = _spheres(world, prim)
    if ball is not None:
        around = cross(tangent, ng)
        if bitangent is not None:
            bitangent = torch.where(ball, cross(normalize(around), ng) * bitangent[0], bitangent)
        tangent = torch.where(ball, around, tangent)
    if world.geometry.counts[2]:
        disk = (prim >= world.geometry.ends[1]) & (prim < world.geometry.ends[2])
        away = torch.addcmul(e1 * u, e2, v)
        square = torch.where(disk, u * u + v * v, 1.0)
        some = square > 0
        tangent = torch.where(disk, torch.where(some, away / torch.where(some, square, 1.0).sqrt(), e1), tangent)
        if bitangent is not None:
            around = torch.addcmul(e2 * u, e1, v, value=-1) * (2.0 * math.pi)
            if world.geometry.mirrored is not None:
                around = torch.where(take(world.geometry.mirrored, prim), -around, around)
            bitangent = torch.where(disk, around, bitangent)
    return tangent, bitangent


def _sphere_distance(o: Tensor, d: Tensor, centre: Tensor, radius: Tensor, near: Tensor) -> Tensor:
    """The root next to the search's ``near``, with the derivative of the sphere's implicit equation at it."""
    t = near.detach()
    f = o + d * t - centre
    # One Newton step on |f|^2 = r^2; the slope is a constant of it, so the value is polished and the derivative right.
    slope = (2.0 * dot(f, d)).detach()
    return t - (dot(f, f) - radius * radius) / torch.where(slope == 0, 1.0, slope)


def reattach(world: World, x: Tensor, hit: Hit, wi: Tensor) -> tuple[Tensor, Tensor]:
    """Let a traced direction follow both of its ends.

    Args:
        world: the scene's tensors, with gradients.
        x: where the ray left, differentiable ``(3, N)``.
        hit: what it found; the point is held at ``u, v`` of its primitive (on a sphere: at its normal,
            on a quadric: at its place in its own space).
        wi: the traced direction ``(3, N)``; kept for misses.

    Returns:
        The direction ``(3, N)`` and the factor ``(N,)`` of value 1 whose derivative is that of the change of measure from
        solid angle to the surface, ``|cos| dA / r^2``.
    """
    missed = hit.prim < 0
    place = _placed(world, hit.prim.clamp_min(0))
    prim, p0, e1, e2 = place.prim, place.p0, place.e1, place.e2
    y = affine(p0, e1, hit.u, e2, hit.v)
    area = cross(e1, e2)
    ball, curved = _spheres(world, prim), _quadrics(world, prim)
    if ball is not None:
        radius = torch.where(ball, e1[0], 1.0)
        outward = normalize((x + wi * torch.where(missed, 0.0, hit.t) - p0).detach())
        y = torch.where(ball, p0 + outward * radius, y)
        area = torch.where(ball, outward * (radius * radius), area)
    if curved is not None:
        table = quadrics.rows(world, prim)
        own = quadrics.place(table.code, torch.where(curved, hit.u, 0.0), torch.where(curved, hit.v, 0.0))
        y = torch.where(curved, affine(p0 + e1 * own[0], e2, own[1], table.e3, own[2]), y)
        area = torch.where(curved, quadrics.direction(table, quadrics.normal(table.code, own)), area)
    offset = torch.where(missed, wi, y - x)
    square = dot(offset, offset)
    direction = offset / square.sqrt()
    measure = dot(direction, torch.where(missed, wi, area)).abs() / torch.where(missed, 1.0, square)
    value = measure.detach()
    usable = ~missed & (value > 0)
    ratio = torch.where(usable, measure / torch.where(usable, value, 1.0), 1.0)
    # The value stays the traced direction's own: only its derivative is new.
    return wi + (direction - direction.detach()), ratio


def offset_origin(world: World, at: Interaction, w: Tensor) -> Tensor:
    """Origins ``(3, N)`` for rays that leave in directions ``w``, moved off the surface on the side they leave by.

    Waechter and Binder (*A Fast and Robust Method for Avoiding Self-Intersection*, Ray Tracing Gems, 2019) for the idea.
    """
    step = (take(world.geometry.bound, at.prim) if at.bound is None else at.bound) * OFFSET
    return torch.addcmul(at.p, at.ng, torch.copysign(step, dot(w, at.ng)))
