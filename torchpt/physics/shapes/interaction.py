"""Surface interactions of hits, recomputed from ``prim, u, v`` with gradients.

The search has no gradients. Computing the point from the corners of its primitive is more accurate than ``o + t d`` and
makes any search differentiable. The derivative can be taken in two parametrizations, with the same values:

- the ray stays fixed and the point slides along it: ``follow_ray``;
- the point stays fixed on its surface and the direction follows it (the material form of Zhang, Miller, Yan, Gkioulekas, Zhao,
  *Path-Space Differentiable Rendering*, 2020; its interior term).

Camera rays take the first. Behind a surface :func:`reattach` blends the two by the length of the ray: near points slide, since
the geometry term of points that are held has a derivative of the order of one over their distance, which has no variance; far
points are held, since each point that slides hands its motion, over the cosine, to the next.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.math.vectors import affine, cross, dot, largest, normalize, take
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.shapes.primitive import LanePrimitives, Primitive, Rays, lane_primitives
from torchpt.physics.world import World

__all__ = ["OFFSET", "interact", "offset_origin", "reattach", "slide_share"]

#: Rays leave a surface ``OFFSET * world.geometry.bound`` off its plane. Re-deriving a point and evaluating its plane in the
#: search each round by less than ``4 * 2^-24 * 2 bound``; this is twice their sum, and scales with the scene.
OFFSET = 2.0**-19
#: Distances below this fraction of the coordinates count as 0 and have no derivative, in :func:`reattach`: 2^9 units in the
#: last digit of float32.
NEAR = 2.0**-15


def _plane_uv(o: Tensor, d: Tensor, p0: Tensor, e1: Tensor, e2: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``u, v`` of rays in the primitives' planes, differentiable in all arguments.

    Moeller and Trumbore, *Fast, Minimum Storage Ray-Triangle Intersection*, 1997, in their notation.
    """
    pvec = cross(d, e2)
    det = dot(e1, pvec)
    inverse = 1.0 / torch.where(det == 0, 1.0, det)
    tvec = o - p0
    return dot(tvec, pvec) * inverse, dot(d, cross(tvec, e1)) * inverse


def _not_flat(world: World, prim: Tensor) -> list[tuple[type[Primitive], Tensor]]:
    """Return the kinds in the scene that are not flat (spheres, quadrics), each with the mask of its lanes ``(N,)``."""
    return [(kind, world.geometry.mask_of_kind(kind, prim)) for kind in world.geometry.kinds if not kind.flat]


def interact(world: World, o: Tensor, d: Tensor, hit: Hit, follow_ray: bool = False) -> Interaction:
    """Return the surface interactions of hits ``(N,)``, none of them a miss.

    Args:
        world: the scene's tensors.
        o: ray origins ``(3, N)``.
        d: ray directions ``(3, N)``.
        hit: hits of the search.
        follow_ray: re-intersect the ray with the primitive, so that the point follows ``o``, ``d`` and the geometry.
    """
    geometry, primitives = world.geometry, lane_primitives(world, hit.prim)
    prim, p0, e1, e2, u, v = primitives.prim, primitives.p0, primitives.e1, primitives.e2, hit.u, hit.v
    not_flat = _not_flat(world, prim)
    if follow_ray:
        along_u, along_v = _plane_uv(o, d, p0, e1, e2)
        if o.dtype == torch.float64:  # more accurate than the float32 of the search
            u, v = along_u, along_v
        else:  # the search is more accurate where a ray grazes the plane
            u, v = u + (along_u - along_u.detach()), v + (along_v - along_v.detach())
    # In lanes of kinds that are not flat u and v are no affine coordinates: at 0 the sum below stays finite until
    # ``hit_points`` replaces it.
    for _, is_kind in not_flat:
        u, v = torch.where(is_kind, 0.0, u), torch.where(is_kind, 0.0, v)
    p = affine(p0, e1, u, e2, v)
    ng = (
        take(geometry.normal, prim)
        if primitives.copies is None
        else primitives.normals_to_instance(take(geometry.normal, prim))
    )
    bound, own = None, None  # fields of Interaction: rounding bound, point in object space
    if primitives.is_instanced is not None and primitives.coordinate_bound is not None:
        bound = torch.where(
            primitives.is_instanced, dot(ng.detach().abs(), primitives.coordinate_bound), take(geometry.bound, prim)
        )
    for kind, is_kind in not_flat:
        points = kind.hit_points(world, primitives, Rays(o=o, d=d, hit=hit, follow_ray=follow_ray), is_kind)
        p, ng = torch.where(is_kind, points.p, p), torch.where(is_kind, points.ng, ng)
        if points.bound is not None:
            bound = torch.where(is_kind, points.bound, take(geometry.bound, prim) if bound is None else bound)
        own = own if points.own is None else points.own
    ns = ng
    if geometry.normals is not None:
        corners = [take(n, prim) for n in geometry.normals]
        if primitives.copies is not None:
            corners = [primitives.normals_to_instance(n) for n in corners]
        ns = normalize(affine(corners[0] * (1.0 - u - v), corners[1], u, corners[2], v))
        if any(geometry.counts[1:]):  # only triangles, which come first, have normals at their corners
            ns = torch.where(prim < geometry.ends[0], ns, ng)
    slot = geometry.slot(hit.prim)
    at = Interaction(
        p=p, ng=ng, ns=ns, tangent=None, bitangent=None, prim=prim, slot=slot, bound=bound, u=u, v=v, own=own
    )
    return _framed(world, primitives, at)


def _framed(world: World, primitives: LanePrimitives, at: Interaction) -> Interaction:
    """Return surface points with tangents and bitangents added, if the world has them."""
    geometry = world.geometry
    if geometry.tangents is None:
        return at
    tangent = take(geometry.tangents, at.prim)
    bitangent = None if geometry.bitangents is None else take(geometry.bitangents, at.prim)
    at = replace(at, tangent=tangent, bitangent=bitangent)
    for kind in (kind for kind in geometry.kinds if kind.has_own_uv):
        is_kind = geometry.mask_of_kind(kind, at.prim)
        along_u, along_v = kind.tangents(world, primitives, at, is_kind)
        tangent = torch.where(is_kind, along_u, tangent)
        bitangent = None if bitangent is None or along_v is None else torch.where(is_kind, along_v, bitangent)
    if primitives.is_instanced is not None:
        tangent = torch.where(primitives.is_instanced, primitives.vectors_to_instance(tangent), tangent)
        bitangent = (
            None
            if bitangent is None
            else torch.where(primitives.is_instanced, primitives.vectors_to_instance(bitangent), bitangent)
        )
    return replace(at, tangent=tangent, bitangent=bitangent)


def slide_share(world: World, prim: Tensor, r: Tensor, near: Tensor) -> Tensor:
    """Return the share ``(N,)`` by which a point slides along the ray that meets it, in place of being held.

    It is ``exp(-(r / near)^2)``, and 0 on emitters, whose points light sampling holds.

    Args:
        world: the scene's tensors.
        prim: primitives of the points ``(N,)``, none of them a miss.
        r: lengths of the rays ``(N,)``.
        near: ``(1,)`` length over which points slide.
    """
    share = torch.exp(-(r / near).square())
    if world.lights is None or world.lights.row_of_prim is None:
        return share
    emits = take(world.lights.row_of_prim, world.geometry.slot(prim)) >= 0
    return torch.where(emits, 0.0, share)


def reattach(world: World, x: Tensor, hit: Hit, wi: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """Make a traced direction differentiable in both of its end points.

    With the share ``a`` of :func:`slide_share` the motion of the direction is ``D = (1 - a) dw``, where ``dw`` turns with the
    points if both are held. A ray with this motion meets the moving surface at the point that is held by ``1 - a`` and slides
    by ``a``. The derivative of the measure is the divergence of ``D``: ``1 - a`` times that of ``|cos| dA / r^2``, less the
    slope of ``a`` along ``dw``; the distance changes by ``-r (n dw) / (n w)`` with the direction, ``n`` the normal.

    Args:
        world: the scene's tensors, with gradients.
        x: origins, differentiable ``(3, N)``.
        hit: hits of the rays. Points that are held stay at ``u, v`` of their primitives (on a sphere at their normal, on a
            quadric at their position in object space).
        wi: traced directions ``(3, N)``; unchanged for misses.
        near: ``(1,)`` length over which points slide.

    Returns:
        The direction ``(3, N)``, and a factor ``(N,)`` of value 1 with the relative derivative of the measure.
    """
    missed = hit.prim < 0
    primitives = lane_primitives(world, hit.prim.clamp_min(0))
    y = affine(primitives.p0, primitives.e1, hit.u, primitives.e2, hit.v)
    # Along the normal of ``y``; the length is the area in the world for one unit of area in the parametrization.
    area = cross(primitives.e1, primitives.e2)
    not_flat = _not_flat(world, primitives.prim)
    if not_flat:
        rays = Rays(o=x, d=wi, hit=replace(hit, t=torch.where(missed, 0.0, hit.t)))
        for kind, is_kind in not_flat:
            fixed = kind.fixed_points(world, primitives, rays, is_kind)
            y, area = torch.where(is_kind, fixed.p, y), torch.where(is_kind, fixed.area, area)
    offset = torch.where(missed, wi, y - x)
    square = dot(offset, offset)
    # Points within rounding of each other count as one: a ray that leaves beside an edge may hit the other face of that edge.
    least = largest(torch.maximum(x.detach().abs(), y.detach().abs())) * NEAR
    apart = missed | (square.detach() > least * least)
    square = torch.where(apart, square, 1.0)
    direction = offset / square.sqrt()
    share = slide_share(world, hit.prim.clamp_min(0), square.detach().sqrt(), near)
    held = 1.0 - share
    area = torch.where(missed, wi, area)
    projected = dot(direction, area)  # the cosine times the area
    measure = projected.abs() / torch.where(missed, 1.0, square)
    value, cosine = measure.detach(), projected.detach()
    usable = apart & ~missed & (value > 0)
    turn = direction - direction.detach()
    slope = -2.0 * (square.detach() / near.square()) * share  # of the share by the logarithm of the distance
    along = dot(turn, area.detach()) / torch.where(usable, cosine, 1.0)
    change = held * (measure / torch.where(usable, value, 1.0) - 1.0) + slope * along
    ratio = torch.where(usable, 1.0 + change, 1.0)
    # The value stays the traced direction; only the derivative is added.
    return torch.where(apart & ~missed, wi + held * turn, wi), ratio


def offset_origin(world: World, at: Interaction, w: Tensor) -> Tensor:
    """Return origins ``(3, N)`` of rays in directions ``w (3, N)``, moved off the surface to the side of ``w``.

    After Waechter and Binder, *A Fast and Robust Method for Avoiding Self-Intersection*, Ray Tracing Gems, 2019.
    """
    # ``at.bound`` is None if the scene has only primitives whose bound is in the table.
    step = (take(world.geometry.bound, at.prim) if at.bound is None else at.bound) * OFFSET
    return torch.addcmul(at.p, at.ng, torch.copysign(step, dot(w, at.ng)))
