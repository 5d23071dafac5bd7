"""Curves in which surfaces cut through each other, such as the line where a cylinder that is sunk into a floor meets it.

Such a curve lies on both surfaces and moves with both. With ``n_A``, ``n_B`` their normals and ``τ`` along the curve its
velocity is ``n_A·v = n_A·v_A``, ``n_B·v = n_B·v_B``, ``τ·v = 0``: the point held on A, moved on A as far as B asks for::

    v = v_A + u n_B·(v_B - v_A) / (n_B·u),    u = τ × n_A

Curves are written in the numbers of the flat surface A: a line where B is flat too, an ellipse or two lines where it is a
sphere, an ellipsoid, a cylinder or a cone. Left out: a cone cut lengthwise (a hyperbola), two round surfaces, and a mesh that
cuts through itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchpt.core.errors import EdgeWarning, warn_caller
from torchpt.gradients.edges.bodies import ROUNDING, Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.curves import Curves, circles, corners, joined, known, straight
from torchpt.gradients.edges.meshes import neighbours_of
from torchpt.math.vectors import cross, dot, rows, take
from torchpt.scene import Scene

__all__ = ["Crossing", "Cuts", "crossing_of", "cuts_of"]

#: Curves, and their lengths ``(N,)``.
Cuts = tuple[Curves, Tensor]

#: Pairs of primitives that are looked at at a time, and at all: a second's work for each some million.
_PAIRS, _MOST = 1 << 21, 1 << 22
#: Flat surfaces at a smaller sine do not cut.
_PARALLEL = 1e-5
#: Curves that are so near a border, in a flat surface's own numbers, are that border: there surfaces touch.
_TOUCH = 1e-6
#: Least determinant, against the square of the trace, at which a conic is an ellipse.
_ELLIPSE = 1e-10
#: Angles at which an ellipse is compared with the border of a disk, and halvings of the step between them.
_PLACES, _HALVINGS = 64, 40
#: Points of a curve by which its length is found.
_POINTS = 8


# ---- How a cut moves


@dataclass(frozen=True)
class Crossing:
    """Those K of N points that lie on cuts.

    Attributes:
        lane: ``(K,)`` of the points.
        own: the points.
        other: the same held on the other surface.
        across: unit normals of that ``(3, K)``.
        shift: ``(3, K)`` how points move in their own surface for a motion of 1 along ``across``.
    """

    lane: Tensor
    own: Held
    other: Held
    across: Tensor
    shift: Tensor

    def moved(self, bodies: Bodies, p: Tensor) -> Tensor:
        """Return points ``p (3, N)``, held on their own surfaces, where the cuts are; differentiable in ``bodies``."""
        apart = dot(self.across, bodies.points(self.other) - take(p, self.lane))
        return p.index_add(1, self.lane, self.shift * apart)

    def pull_back(self, cotangents: Cotangents, cotangent: Tensor) -> None:
        """Add what a cotangent ``(3, N)`` of :meth:`moved` points asks, beside itself of the points on their own surfaces."""
        apart = dot(self.shift, take(cotangent, self.lane))
        cotangents.add_points(self.other, self.across * apart)
        cotangents.add_points(self.own, self.across * -apart)


def crossing_of(bodies: Bodies, cut: Tensor, held: Held, mate: Tensor) -> Crossing | None:
    """Return those of N points that lie on cuts; None where none does.

    Args:
        bodies: detached.
        cut: ``(N,)`` bool: which.
        held: the points.
        mate: the other primitive at each ``(N,)``.
    """
    lane = cut.nonzero().squeeze(1)
    if not len(lane):
        return None
    own, other = rows(held, lane), take(mate, lane)
    on_other = Held(other, bodies.own(other, bodies.points(own)))
    n, across = bodies.normals(own), bodies.normals(on_other)
    u = cross(cross(n, across), n)
    return Crossing(lane, own, on_other, across, u / dot(across, u))


# ---- Where surfaces cut


def cuts_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Cuts | None:
    """Return the curves; None where there are none, and, with a warning, where there are too many pairs to look at.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
    """
    found: list[Curves] = []
    seams = _Seams(scene, bodies, poses)
    for one, two in _pairs(scene, bodies):
        flat = bodies.is_flat(two)
        some = flat.nonzero().squeeze(1)
        if len(some):
            found += _flat_cuts(bodies, take(one, some), take(two, some), seams)
        some = (~flat).nonzero().squeeze(1)
        if len(some):
            found += _round_cuts(bodies, take(one, some), take(two, some), scene.space.shift[:, None])
    found = [curves for curves in found if len(curves.prim)]
    if not found:
        return None
    curves = joined(found)
    curves = replace(curves, cut=torch.ones_like(curves.cut))
    span, length = curves.high - curves.low, torch.zeros_like(curves.low)
    for k in range(_POINTS):
        _, _, along = curves.moving(bodies, curves.low + span * ((k + 0.5) / _POINTS))
        length += dot(along, along).sqrt() * (span / _POINTS)
    return curves, length


def _pairs(scene: Scene, bodies: Bodies) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield pairs of primitives of different shapes whose boxes overlap, the first of which is flat, block by block."""
    owners = _owners(scene, bodies)
    if len({name for name, _, _ in owners}) < 2:
        return
    prim = torch.arange(sum(count for _, _, count in owners), device=scene.device)
    low, high = bodies.boxes(prim)
    wanted, shape = torch.zeros_like(prim, dtype=torch.bool), torch.zeros_like(prim)
    names = {name: k for k, name in enumerate(dict.fromkeys(name for name, _, _ in owners))}
    spans = [slice(first, first + count) for _, first, count in owners]
    for (name, _, _), span in zip(owners, spans, strict=True):
        shape[span] = names[name]
    lows = torch.stack([low[:, span].amin(1) for span in spans], 1)
    highs = torch.stack([high[:, span].amax(1) for span in spans], 1)
    which = torch.tensor([names[name] for name, _, _ in owners], device=scene.device)
    for k, span in enumerate(spans):
        near = _overlap(lows[:, k : k + 1], highs[:, k : k + 1], lows, highs) & (which != which[k])
        for j in near.nonzero().squeeze(1).tolist():
            wanted[span] |= _overlap(low[:, span], high[:, span], lows[:, j : j + 1], highs[:, j : j + 1])
    wanted &= ~_unknown(scene, bodies, prim)
    prim = wanted.nonzero().squeeze(1)
    if not len(prim):
        return
    low, high, shape = take(low, prim), take(high, prim), take(shape, prim)
    # Boxes in the order of their lower ends along the longest way: each may overlap those that follow up to its upper end.
    axis = int((high.amax(1) - low.amin(1)).argmax())
    order = low[axis].argsort()
    prim, low, high, shape = take(prim, order), take(low, order), take(high, order), take(shape, order)
    after = torch.searchsorted(low[axis].contiguous(), high[axis].contiguous(), right=True)
    count = (after - torch.arange(len(prim), device=prim.device) - 1).clamp_min(0)
    ends = count.cumsum(0)
    if int(ends[-1]) > _MOST:
        said = "the gradient leaves out curves where surfaces cut: too many of their triangles are near each other"
        warn_caller(said, EdgeWarning)
        return
    flat = bodies.is_flat(prim)
    for first in range(0, int(ends[-1]), _PAIRS):
        number = torch.arange(first, min(first + _PAIRS, int(ends[-1])), device=prim.device)
        one = torch.searchsorted(ends, number, right=True)
        two = one + 1 + number - (take(ends, one) - take(count, one))
        good = _overlap(take(low, one), take(high, one), take(low, two), take(high, two))
        good &= (take(shape, one) != take(shape, two)) & (take(flat, one) | take(flat, two))
        some = good.nonzero().squeeze(1)
        one, two = take(one, some), take(two, some)
        swap = ~take(flat, one)
        yield take(prim, torch.where(swap, two, one)), take(prim, torch.where(swap, one, two))


def _owners(scene: Scene, bodies: Bodies) -> list[tuple[str, int, int]]:
    """Return the shape, the first primitive and the number of primitives of each part and copy."""
    found, at, counts = list[tuple[str, int, int]](), 0, dict[str, int]()
    for part in scene.built.parts:
        found.append((part.shape, at, part.primitive_count))
        counts[part.name] = part.primitive_count
        at += part.primitive_count
    for copy in scene.built.copies:
        found.append((copy.shape, at, counts[copy.of]))
        at += counts[copy.of]
    return found


def _unknown(scene: Scene, bodies: Bodies, prim: Tensor) -> Tensor:
    """Return a mask ``(P,)`` of quadrics that cuts are not known of."""
    forms = [part.quadric.form for part in scene.built.parts if part.quadric is not None]
    if all(known(form) for form in forms):
        return torch.zeros_like(prim, dtype=torch.bool)
    odd = torch.tensor([not known(form) for form in forms], device=prim.device)
    mine = (prim >= bodies.first_quadric) & (prim < sum(bodies.counts))
    return mine & take(odd, (prim - bodies.first_quadric).clamp(0, len(odd) - 1))


def _overlap(low: Tensor, high: Tensor, others_low: Tensor, others_high: Tensor) -> Tensor:
    """Return a mask of the boxes ``(3, N)`` that overlap."""
    return ((low <= others_high) & (others_low <= high)).all(0)


# ---- In the numbers of a flat surface: functions ``g (3, N)`` stand for ``g0 + g1 a0 + g2 a1``


def _on(bodies: Bodies, one: Tensor, two: Tensor) -> Tensor:
    """Return the numbers of ``two`` as functions on ``one``: ``(3 numbers, 3, N)``."""
    p0, x, y, _ = bodies.place(one)
    base = bodies.own(two, p0)
    return torch.stack((base, bodies.own(two, p0 + x) - base, bodies.own(two, p0 + y) - base), 1)


def _limits(bodies: Bodies, prim: Tensor, b0: Tensor, b1: Tensor) -> list[Tensor]:
    """Return functions that are not negative within flat primitives ``(N,)``, by their numbers; of disks constant ones."""
    triangle = bodies.is_triangle(prim)
    disk = ~triangle & (prim >= sum(bodies.counts[:2]))
    one = torch.zeros_like(b0)
    one[0] = 1.0
    rest = one - b0 - b1
    every = b0, b1, torch.where(triangle, rest, one - b0), torch.where(triangle, rest, one - b1)
    return [torch.where(disk, one, g) for g in every]


def _touch(off: Tensor, *axes: Tensor) -> Tensor:
    """Return how near a border of a primitive, in its own numbers along ``axes``, curves are that border ``(N,)``.

    ``off``: ``(N,)`` by how much rounding moves the curves.
    """
    shortest = torch.stack([dot(axis, axis) for axis in axes]).amin(0).sqrt()
    return (off / shortest).clamp_min(_TOUCH)


def _off(bodies: Bodies, along: Tensor, shift: Tensor, *prims: Tensor) -> Tensor:
    """Return by how much rounding moves primitives along directions ``(3, N)``; ``shift``: of the lanes' coordinates."""
    return bodies.rounding(along, *prims) + dot(along.abs(), shift.abs()) * ROUNDING


def _is_disk(bodies: Bodies, prim: Tensor) -> Tensor:
    return (prim >= sum(bodies.counts[:2])) & (prim < bodies.first_sphere)


def _identity(like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers themselves as functions ``(3, N)``."""
    a0, a1 = torch.zeros_like(like), torch.zeros_like(like)
    a0[1], a1[2] = 1.0, 1.0
    return a0, a1


#: The corners of triangles off the limits, in the order of :func:`_limits`.
_OFF = 1, 2, 0, 0


@dataclass(frozen=True)
class _Seams:
    """Edges between triangles of one mesh.

    Attributes:
        scene: whose.
        bodies: detached.
        poses: the parameters.
    """

    scene: Scene
    bodies: Bodies
    poses: dict[str, Tensor]

    @cached_property
    def behind(self) -> Tensor:
        """Return :func:`~torchpt.gradients.edges.meshes.neighbours_of`: few cuts ask for them."""
        return neighbours_of(self.scene, self.bodies, self.poses)

    def are_cut(self, prim: Tensor, corner: int, other: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of edges of triangles ``prim (N,)`` along which flat surfaces ``other`` cut a mesh.

        Those of its border are touched alone, as are those with both triangles to one side. An edge counts with the triangle
        of the lower id. ``corner``: that off the edge.
        """
        bodies = self.bodies
        good = bodies.is_triangle(prim)
        mate = torch.where(good, take(self.behind[corner], torch.where(good, prim, 0)), -1)
        index = (mate > prim).nonzero().squeeze(1)
        one, two, plane = (take(t, index) for t in (prim, mate, other))
        back = (take(self.behind, two) == one).to(torch.uint8).argmax(0)
        n, shift = bodies.normals(Held(plane, torch.zeros_like(corners(back)))), self.scene.space.shift[:, None]
        sides = []
        for triangle, third in ((one, torch.full_like(back, corner)), (two, back)):
            above = dot(n, bodies.points(Held(triangle, corners(third))) - bodies.place(plane)[0])
            sides.append(torch.where(above.abs() > _off(bodies, n, shift, triangle, plane), above, 0.0))
        found = torch.zeros_like(good)
        found[index] = sides[0] * sides[1] < 0
        return found


def _line(
    one: Tensor,
    two: Tensor,
    at: Tensor,
    d: Tensor,
    limits: list[Tensor],
    touch: list[Tensor],
    disks: list[tuple[Tensor, Tensor, Tensor]],
    seams: _Seams | None = None,
) -> Curves:
    """Return lines ``at + t d (2, N)`` on flat primitives, within limits and within disks (which, and their numbers).

    ``touch``: how near a limit lines only touch it. ``seams``: where both primitives are flat, and the limits are those of the
    first and the second: lines along edges within a mesh count too.
    """
    low, high = torch.full_like(at[0], -torch.inf), torch.full_like(at[0], torch.inf)

    def along(g: Tensor) -> tuple[Tensor, Tensor]:
        return g[0] + g[1] * at[0] + g[2] * at[1], g[1] * d[0] + g[2] * d[1]

    def clip(some: Tensor, begin: Tensor, end: Tensor) -> None:
        nonlocal low, high
        low = torch.where(some & (begin > low), begin, low)
        high = torch.where(some & (end < high), end, high)

    everywhere = torch.full_like(low, torch.inf)
    for g, near in zip(limits, touch, strict=True):
        a, slope = along(g)
        a = a if seams is None else a + 2.0 * near
        zero = -a / torch.where(slope == 0, 1.0, slope)
        clip(slope > 0, zero, everywhere)
        clip(slope < 0, -everywhere, zero)
        clip((slope == 0) & (a < 0), everywhere, -everywhere)
    for mask, b0, b1 in disks:
        (p, u), (q, v) = along(b0), along(b1)
        square, half, rest = u * u + v * v, p * u + q * v, p * p + q * q - 1.0
        inner = half * half - square * rest
        root = inner.clamp_min(0.0).sqrt()
        square = torch.where(square > 0, square, 1.0)
        clip(mask, (-half - root) / square, (-half + root) / square)
        clip(mask & (inner <= 0), everywhere, -everywhere)
    good = (high > low) & torch.isfinite(low) & torch.isfinite(high)
    middle = torch.where(good, 0.5 * (low + high), 0.0)
    for k, g in enumerate(limits):
        a, slope = along(g)
        inside = a + slope * middle
        at_edge = good & (inside.abs() <= touch[k])
        good &= inside > touch[k]
        if seams is not None:
            edge = at_edge.nonzero().squeeze(1)
            if len(edge):
                prim, other = rows((one, two) if k < len(_OFF) else (two, one), edge)
                good[edge] = seams.are_cut(prim, _OFF[k % len(_OFF)], other)
    index = good.nonzero().squeeze(1)
    at, d, low, high = take(at, index), take(d, index), take(low, index), take(high, index)
    ends = [torch.cat((at + d * t, torch.zeros_like(at[:1]))) for t in (low, high)]
    return straight(take(one, index), ends[0], ends[1], take(two, index))


def _flat_cuts(bodies: Bodies, one: Tensor, two: Tensor, seams: _Seams) -> list[Curves]:
    """Return the lines in which flat surfaces cut."""
    zero = torch.zeros(3, len(one), dtype=torch.float64, device=one.device)
    n = [bodies.normals(Held(prim, zero)) for prim in (one, two)]
    b0, b1, height = _on(bodies, one, two)
    size = (height[1] * height[1] + height[2] * height[2]).sqrt()
    steep = cross(n[0], n[1])
    some = ((dot(steep, steep) > _PARALLEL * _PARALLEL) & (size > 0)).nonzero().squeeze(1)
    one, two, size, n, steep, b0, b1, height = rows((one, two, size, n, steep, b0, b1, height), some)
    at = -height[1:] * (height[0] / (size * size))
    d = torch.stack((-height[2], height[1])) / size
    a0, a1 = _identity(height)
    limits = _limits(bodies, one, a0, a1) + _limits(bodies, two, b0, b1)
    # Where one plane is off along its normal, the line is off by more the flatter the planes cut.
    shift, sine = seams.scene.space.shift[:, None], dot(steep, steep).sqrt()
    touch = []
    for prim, across in ((one, n[1]), (two, n[0])):
        touch += [_touch(_off(bodies, across, shift, one, two) / sine, *bodies.place(prim)[1:3])] * len(_OFF)
    disks = [(_is_disk(bodies, one), a0, a1), (_is_disk(bodies, two), b0, b1)]
    return [_line(one, two, at, d, limits, touch, disks, seams)]


def _round_cuts(bodies: Bodies, one: Tensor, two: Tensor, shift: Tensor) -> list[Curves]:
    """Return the ellipses and lines in which flat surfaces ``one`` cut round ones ``two``.

    ``shift``: ``(3, 1)`` of the lanes' coordinates.
    """
    q = _on(bodies, one, two)
    forms = bodies.forms_of(two)
    bend, middle, level = forms[0], forms[1], forms[2]
    limits = _limits(bodies, one, *_identity(q[0]))
    ends = torch.isfinite(forms[3])
    whole = torch.zeros_like(q[0])
    whole[0] = 1.0
    limits += [torch.where(ends, q[2] - whole * forms[3].nan_to_num(), whole)]
    limits += [torch.where(ends, whole * forms[4].nan_to_num() - q[2], whole)]
    off = _off(bodies, bodies.normals(Held(one, torch.zeros_like(q[0]))), shift, one, two)
    _, x, y, z = bodies.place(two)
    touch = [_touch(off, *bodies.place(one)[1:3])] * len(_OFF) + [_touch(off, z)] * 2
    w = torch.stack((q[0], q[1], q[2] - whole * middle))
    by = torch.stack((torch.ones_like(bend), torch.ones_like(bend), bend))

    def product(i: int, j: int) -> Tensor:
        return (by * w[:, i] * w[:, j]).sum(0)

    # The surface's equation on the plane: a'Aa + 2 l'a + c = 0
    a11, a12, a22, l1, l2 = product(1, 1), product(1, 2), product(2, 2), product(0, 1), product(0, 2)
    c = product(0, 0) - level
    det, trace = a11 * a22 - a12 * a12, a11 + a22
    round_cut = (a11 > 0) & (det > _ELLIPSE * trace * trace)
    safe = torch.where(round_cut, det, 1.0)
    x, y = (a12 * l2 - a22 * l1) / safe, (a12 * l1 - a11 * l2) / safe
    size = -(l1 * x + l2 * y) - c
    index = (round_cut & (size > _TOUCH)).nonzero().squeeze(1)
    found = [_ellipses(*rows((one, two, x, y, size, a11, a12, det, limits, touch, _is_disk(bodies, one)), index))]
    lines = (~round_cut & (det.abs() <= _ELLIPSE * trace * trace) & (bend == 0)).nonzero().squeeze(1)
    if len(lines):
        one, two, trace, a11, a12, a22, l1, l2, c = rows((one, two, trace, a11, a12, a22, l1, l2, c), lines)
        limits, touch = rows((limits, touch), lines)
        wide = a11 > a22
        v = torch.stack((torch.where(wide, a11, a12), torch.where(wide, a12, a22)))
        v = v / (v * v).sum(0).sqrt().clamp_min(torch.finfo(v.dtype).tiny)
        half = l1 * v[0] + l2 * v[1]
        inner = half * half - trace * c
        root = inner.clamp_min(0.0).sqrt()
        disk = [(_is_disk(bodies, one), *_identity(limits[0]))]
        d = torch.stack((-v[1], v[0]))
        some = (inner > _TOUCH * trace).nonzero().squeeze(1)
        for sign in (1.0, -1.0):
            at = v * ((sign * root - half) / trace)
            found.append(_line(*rows((one, two, at, d, limits, touch, disk), some)))
    return found


def _ellipses(
    one: Tensor,
    two: Tensor,
    x: Tensor,
    y: Tensor,
    size: Tensor,
    a11: Tensor,
    a12: Tensor,
    det: Tensor,
    limits: list[Tensor],
    touch: list[Tensor],
    disk: Tensor,
) -> Curves:
    """Return the arcs of ellipses about ``x, y`` on flat surfaces (``disk``: those that are disks) that are within limits."""
    radius, low = size.sqrt(), a11.sqrt()
    # With A = L L' points are the middle and L'^-1 (cos t, sin t) times the radius.
    b = torch.stack((radius / low, torch.zeros_like(x), torch.zeros_like(x)))
    c = torch.stack((-a12 / (low * det.sqrt()) * radius, low / det.sqrt() * radius, torch.zeros_like(x)))
    middle = torch.stack((x, y, torch.zeros_like(x)))

    def parts(g: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        flat = [g[1] * v[0] + g[2] * v[1] for v in (middle, b, c)]
        return g[0] + flat[0], flat[1], flat[2]

    turns = [torch.zeros_like(x), torch.full_like(x, 2.0 * math.pi)]
    for g in limits:
        g0, gc, gs = parts(g)
        reach = (gc * gc + gs * gs).sqrt()
        crosses = g0.abs() < reach
        half = torch.acos(torch.where(crosses, -g0 / torch.where(crosses, reach, 1.0), 0.0))
        turn = torch.atan2(gs, gc)
        for t in (turn + half, turn - half):
            turns.append(torch.where(crosses, torch.remainder(t, 2.0 * math.pi), 0.0))

    def beyond(t: Tensor) -> Tensor:
        """Return how far outside of the disk a curve is, negative within and where it lies on no disk."""
        at = middle[:2] + b[:2] * torch.cos(t) + c[:2] * torch.sin(t)
        return torch.where(disk, (at * at).sum(0) - 1.0, -1.0)

    turns += _zeros(beyond, x) if bool(disk.any()) else []
    ends = torch.stack(turns).sort(0).values
    begin, end = ends[:-1], ends[1:]
    t = 0.5 * (begin + end)
    good = end - begin > 1e-9
    for g, near in zip(limits, touch, strict=True):
        g0, gc, gs = parts(g)
        good &= g0 + gc * torch.cos(t) + gs * torch.sin(t) > near
    good &= torch.stack([beyond(row) < 0 for row in t])
    piece, index = good.nonzero(as_tuple=True)
    arcs = circles(take(one, index), take(middle, index), take(b, index), take(c, index))
    return replace(arcs, mate=take(two, index), low=begin[piece, index], high=end[piece, index])


def _zeros(f: Callable[[Tensor], Tensor], like: Tensor) -> list[Tensor]:
    """Return where functions of an angle, trigonometric polynomials of degree 2, change their sign: 4 times each, 0 if fewer.

    Signs are compared at :data:`_PLACES` angles, so two zeros that are closer together are not found.
    """
    step = 2.0 * math.pi / _PLACES
    above = torch.stack([f(torch.full_like(like, k * step)) > 0 for k in range(_PLACES)])
    changes = above != above.roll(-1, 0)
    first = (
        torch.where(changes, 1.0, 0.0)
        + torch.linspace(0.5, 0.0, _PLACES, dtype=like.dtype, device=like.device)[:, None]
    )
    score, place = first.topk(4, 0)
    found: list[Tensor] = []
    for k in range(4):
        low = place[k] * step
        width, start = torch.full_like(like, step), f(low) > 0
        for _ in range(_HALVINGS):
            width = 0.5 * width
            low = torch.where((f(low + width) > 0) == start, low + width, low)
        found.append(torch.where(score[k] >= 1.0, low, 0.0))
    return found
