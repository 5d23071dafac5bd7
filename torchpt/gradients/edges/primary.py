"""Edges that the camera sees: samples of them, what lies on both sides, and their share of the gradient."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.curves import (
    SEAM,
    Curves,
    Folds,
    View,
    folds_of,
    generator,
    joined,
    plain_of,
    round_outline,
    rounds_of,
    seams_of,
)
from torchpt.gradients.edges.cuts import Crossing, Cuts, crossing_of
from torchpt.gradients.edges.film import Worth, flat_places
from torchpt.gradients.edges.meshes import marked_primitives
from torchpt.gradients.edges.occluders import EdgePoints, Occluders, occluders_of
from torchpt.gradients.edges.traced import Passing, Traced, Use
from torchpt.math.guiding import Round
from torchpt.math.sampling import Distribution1D
from torchpt.math.vectors import cross, dot, rows, take
from torchpt.scene import Scene

__all__ = [
    "Along",
    "Pieces",
    "Primary",
    "distance_to",
    "is_flat",
    "outline_of",
    "pieces_of",
    "share_of",
    "step_of",
    "steps_at",
    "view_of",
]


# ---- How far beside a curve of the film rays are traced, so that they meet what lies along it and nothing beyond


#: Of the film's longer side at a slope of 1.
_STEP = 2.0**-16
#: Where a face is narrow: a share of what is left of it beside its edge, but not less than this share of a whole step, which is
#: still some roundings of a ray's direction.
_SHARE, _LEAST = 0.25, 2.0**-6


def step_of(bodies: Bodies) -> float:
    """Return a whole step, in pixels: a few hundred roundings of a ray's direction."""
    width = float(max(bodies.camera.resolution))
    *_, place, side = bodies.camera.pixel().tolist()
    narrow = max(1.0, 1.0 / (side * width)) if place else 1.0  # by the film at distance 1
    return _STEP * width * narrow


def steps_at(bodies: Bodies, faces: tuple[Tensor, Tensor], s: Tensor, lens: Tensor | None) -> Tensor:
    """Return steps ``(N,)`` in pixels: shorter where a ray a whole step beside an edge would pass a narrow face.

    Args:
        bodies: detached.
        faces: the two faces of each edge ``(N,)``; -1: there is none.
        s: places of the edges on the film ``(2, N)``.
        lens: samples of the lens ``(2, N)``; None: there is none.
    """
    whole = step_of(bodies)
    room = torch.full_like(s[0], whole / _SHARE)
    for prim in faces:
        some = is_flat(bodies, prim).nonzero().squeeze(1)
        if len(some):
            nearest, *others = distance_to(take(s, some), *outline_of(bodies, take(prim, some), rows(lens, some)))
            second = take(room, some)
            for away in others:
                second = torch.minimum(second, torch.maximum(nearest, away))
                nearest = torch.minimum(nearest, away)
            room[some] = second  # the nearest is the edge itself
    return (_SHARE * room).clamp(_LEAST * whole, whole)


def outline_of(bodies: Bodies, prim: Tensor, lens: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return from and to where the sides of triangles and parallelograms ``(N,)`` run on the film, ``(2, sides, N)``.

    There are three sides where the scene has triangles alone; else a triangle has a fourth one of no length.
    """
    corners = bodies.corners(prim)[: 4 if bodies.counts[1] else 3]
    lens = None if lens is None else lens.repeat(1, len(corners))
    places = bodies.film.places(torch.cat(corners, 1), lens).view(2, len(corners), -1)
    return places, places.roll(-1, 1)


def is_flat(bodies: Bodies, prim: Tensor) -> Tensor:
    """Return a mask ``(N,)`` of the primitives that are triangles or parallelograms; copies are of meshes."""
    return (prim >= 0) & ((prim < sum(bodies.counts[:2])) | (prim >= sum(bodies.counts)))


def distance_to(s: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return distances ``(sides, N)`` of places ``(2, N)`` from segments between ``a`` and ``b (2, sides, N)``."""
    x, y = b - a
    u, v = s[:, None] - a
    square = torch.addcmul(x * x, y, y)
    share = (torch.addcmul(u * x, v, y) / torch.where(square > 0, square, 1.0)).clamp(0.0, 1.0)
    u, v = u - x * share, v - y * share
    return torch.addcmul(u * u, v, v).sqrt()


# ---- Edges of several surfaces that lie on one another, as where two walls of a room meet: each counts in part
#
# Along such a seam both sides of one edge are seen at its own distance, and what is seen beside it ends there too. The two
# surfaces are taken to stay together; where only one of them moves the derivative is the mean of those to both sides.


def share_of(
    bodies: Bodies, place: EdgePoints, s: Tensor, lens: Tensor | None, prim: Tensor, near: Tensor, step: Tensor
) -> Tensor:
    """Return the parts ``(N,)`` with which places of edges count.

    Args:
        bodies: detached.
        place: the places.
        s: on the film ``(2, N)``.
        lens: samples of the lens ``(2, N)``; None: there is none.
        prim: what is seen on both sides ``(2, N)``.
        near: whether at the edge's own distance ``(2, N)``.
        step: how far beside the edges that is ``(N,)``, in pixels.
    """
    own = prim == place.held.prim
    other = torch.where(own[0], prim[1], prim[0])
    both = near.all(0) & own.any(0) & ~own.all(0)
    flat = both & (other >= 0) & (place.mate < 0)
    flat = flat & is_flat(bodies, other)
    safe = torch.where(flat, other, 0)
    if not bool(flat.any()):
        return torch.ones_like(step)
    away = distance_to(s, *outline_of(bodies, safe, lens)).amin(0)
    return torch.where(flat & (away < 0.5 * step), 0.5, 1.0)


# ---- What of a scene's curves the camera may see: pieces of them on the film, with their lengths there


#: Pieces that a round curve is cut into.
_CUTS = 64

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Pieces:
    """N pieces of curves to draw places from, evenly by what they weigh.

    Attributes:
        curves: pieces; of straight ones ``t`` runs evenly on the film, not in space.
        near: ``(2, N)`` how ``t`` runs: ``h`` of the film at both ends, see :meth:`torchpt.cameras.Camera.film_of`.
        weight: ``(N,)`` length on the film times importance.
    """

    curves: Curves
    near: Tensor
    weight: Tensor

    def place(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``t (N,)`` of places ``u`` in [0, 1) along each piece on the film, and ``du / dt``."""
        a, b = self.near
        span = self.curves.high - self.curves.low
        share = u * a / (u * a + (1.0 - u) * b)
        across = share * b + (1.0 - share) * a
        return self.curves.low + share * span, a * b / (across * across * span)


def view_of(bodies: Bodies) -> View:
    """Return the camera as a place or a direction."""
    pixel = bodies.camera.pixel().detach()
    return View(pixel[:3, None], float(pixel[3]))


def pieces_of(
    scene: Scene, bodies: Bodies, poses: dict[str, Tensor], bounds: Bounds, cuts: Cuts | None, moves: Tensor | None
) -> Pieces | None:
    """Return all that may be seen within ``bounds`` of the film and moves on it; None where nothing does.

    Args:
        scene: whose.
        bodies: detached.
        poses: the parameters.
        bounds: least and greatest x, then y.
        cuts: the curves where surfaces cut.
        moves: ``(P,)`` bool: primitives that move; None: the camera does, and so all that it sees.
    """
    view = view_of(bodies)
    of_owners = None if moves is None else moves.cpu()
    found = [
        _lines(bodies, *_silhouettes(bodies, folds, view), bounds)
        for folds in folds_of(scene, bodies, poses, of_owners)
    ]
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        for mine, cut in ((fixed.round, _arcs), (~fixed.round, _lines)):
            some = rows(fixed, mine.nonzero().squeeze(1))
            found.append(cut(bodies, some, torch.ones_like(some.low), bounds))
    if cuts is not None:
        for mine, cut in ((cuts[0].round, _arcs), (~cuts[0].round, _lines)):
            some = rows(cuts[0], mine.nonzero().squeeze(1))
            found.append(cut(bodies, some, torch.ones_like(some.low), bounds))
    seams = seams_of(scene, bodies, poses)
    if seams is not None:
        found.append(_lines(bodies, seams, torch.full_like(seams.low, SEAM), bounds))
    for rounds in rounds_of(scene, bodies):
        if rounds.form is None:
            curves, some = round_outline(bodies, rounds.prim, view)
            found.append(_arcs(bodies, curves, some.double(), bounds))
            continue
        for side in (1.0, -1.0):
            curves, some = generator(bodies, rounds.prim, rounds.form, view, torch.full_like(rounds.prim, side))
            found.append(_lines(bodies, curves, some.double(), bounds))
    found = [pieces for pieces in found if len(pieces.weight)]
    if not found:
        return None
    near, weight = torch.cat([p.near for p in found], 1), torch.cat([p.weight for p in found])
    pieces = Pieces(joined([p.curves for p in found]), near, weight)
    if moves is None:
        return pieces
    some = pieces.curves.move(moves).nonzero().squeeze(1)
    return rows(pieces, some) if len(some) else None


def _silhouettes(bodies: Bodies, folds: Folds, view: View) -> tuple[Curves, Tensor]:
    """Return edges that are seen as outlines or creases, and their importance."""
    _held, p, along = folds.curves.moving(bodies, torch.zeros_like(folds.curves.low))
    across = cross(along, view.toward(p))
    one, two = (dot(across, bodies.points(other) - p) for other in folds.others)
    outline = folds.border | (one * two >= 0)
    importance = torch.where(outline, 1.0, folds.crease)
    index = (importance > 0).nonzero().squeeze(1)
    return rows(folds.curves, index), take(importance, index)


def _lines(bodies: Bodies, curves: Curves, importance: Tensor, bounds: Bounds) -> Pieces:
    """Return straight curves clipped to the film; on homogeneous places, since they may run behind the camera."""
    low, high = torch.zeros_like(curves.low), torch.ones_like(curves.low)
    ends = []
    for t in (low, high):
        _, p, _ = curves.moving(bodies, t)
        ends.append(bodies.film.of(p, None))
    begin, end = ends
    x0, x1, y0, y1 = bounds

    def inside(s: Tensor) -> list[Tensor]:
        return [s[0] - x0 * s[2], x1 * s[2] - s[0], s[1] - y0 * s[2], y1 * s[2] - s[1], s[3]]

    for a, b in zip(inside(begin), inside(end), strict=True):
        slope = b - a
        zero = -a / torch.where(slope == 0, 1.0, slope)
        low = torch.where((slope > 0) & (zero > low), zero, low)
        high = torch.where((slope < 0) & (zero < high), zero, high)
        high = torch.where((slope == 0) & (a < 0), -1.0, high)
    first, last = begin + (end - begin) * low, begin + (end - begin) * high
    length = _apart(first, last)
    index = ((high > low) & (first[2] > 0) & (last[2] > 0) & (length * importance > 0)).nonzero().squeeze(1)
    cut = rows(curves.within(low, high), index)
    return Pieces(cut, torch.stack((take(first[2], index), take(last[2], index))), take(length * importance, index))


def _apart(first: Tensor, last: Tensor) -> Tensor:
    """Return distances on the film between homogeneous places of it ``(4, N)``."""
    a, b = (s[:2] / torch.where(s[2] > 0, s[2], 1.0) for s in (first, last))
    return ((a - b) * (a - b)).sum(0).sqrt()


def _arcs(bodies: Bodies, curves: Curves, importance: Tensor, bounds: Bounds) -> Pieces:
    """Return round curves in pieces that may lie on the film; near the camera one weighs as much as the film is wide."""
    some = (importance > 0).nonzero().squeeze(1)
    curves, importance = rows(curves, some), take(importance, some)
    many = torch.arange(len(some), device=some.device).repeat_interleave(_CUTS)
    whole = rows(curves, many)
    step = (whole.high - whole.low) / _CUTS
    low = whole.low + torch.arange(_CUTS, dtype=torch.float64, device=some.device).repeat(len(some)) * step
    cut = whole.within(low, low + step)
    first, last = (bodies.film.of(cut.moving(bodies, t)[1], None) for t in (cut.low, cut.high))
    x0, x1, y0, y1 = bounds
    across = math.hypot(x1 - x0, y1 - y0)
    front = (torch.minimum(first[2], last[2]) > 0) & (torch.minimum(first[3], last[3]) > 0)
    behind = (torch.maximum(first[2], last[2]) <= 0) | (torch.maximum(first[3], last[3]) <= 0)
    length = torch.where(front, _apart(first, last), across)
    a, b = flat_places(first), flat_places(last)
    near = torch.minimum(a, b) - length, torch.maximum(a, b) + length  # no arc leaves its chord by more than that
    outside = (near[0][0] > x1) | (near[1][0] < x0) | (near[0][1] > y1) | (near[1][1] < y0)
    weight = torch.where(behind | (front & outside), 0.0, length.clamp_max(across)) * take(importance, many)
    index = (weight > 0).nonzero().squeeze(1)
    one = torch.ones(2, len(index), dtype=torch.float64, device=index.device)
    return Pieces(rows(cut, index), one, take(weight, index))


# ---- Edges that move across the film: silhouettes, borders and creases that the camera sees
#
# A picture is an integral over the film of the radiance ``L(s)``, which jumps along curves ``s(t)``. As these move, the loss
# changes by the integral along them of ``C (L- - L+) n . ds``, with ``C(s)`` the worth of radiance at s and n the normal toward
# + (Reynolds' transport theorem; Li, Aittala, Durand, Lehtinen, *Differentiable Monte Carlo Ray Tracing through Edge Sampling*,
# 2018). With ``n dt = (ds_y / dt, -ds_x / dt)`` any parameter t of the curve will do. Places are drawn along the curves by
# their length on the film; the radiance on both sides is traced by the same random numbers.


#: A place counts as hidden where a ray beside it ends before this share of the way.
_BEFORE = 1.0 - 2.0**-10
#: The same where the ray meets the edge's own surface, which may come forward quickly.
_OWN = 1.0 - 2.0**-6
#: The same of the ray through the place itself.
_NEAR = 1.0 - 2.0**-14

#: Values ``(C, N)`` that rays ``o, d (3, N)`` bring, by the numbers of their samples.
Look = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Along:
    """Samples along curves on the film: the derivative of the loss is that of ``(weight * places(held)).sum()``.

    Where what is seen is held in place, that of ``beside`` is taken away: where rays ended ``(3, M)``, or, where they met
    nothing, infinity and their directions, and weights ``(2, M)``.
    """

    held: Held
    weight: Tensor  # (2, N)
    lens: Tensor | None
    crossing: Crossing | None = None
    beside: tuple[Tensor, Tensor, Tensor] | None = None

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        p = bodies.points(self.held)
        p = p if self.crossing is None else self.crossing.moved(bodies, p)
        total = (bodies.film.places(p, self.lens) * self.weight).sum()
        if self.beside is None:
            return total
        origin, away, weight = self.beside
        # What is infinitely far moves along with the camera.
        at = torch.where(torch.isfinite(origin), origin, bodies.camera.origin()) + away
        return total - (bodies.film.places(at, None) * weight).sum()  # no camera with a lens holds anything


@dataclass(frozen=True)
class Seen:
    """Draws places of what the camera may see from one point, by length on the film.

    Attributes:
        bodies: detached.
        pieces: what the camera may see.
        choice: among them.
    """

    bodies: Bodies
    pieces: Pieces
    choice: Distribution1D

    def draw(self, u: Tensor, coin: Tensor, lens: Tensor | None) -> EdgePoints:
        """Return a point for each lane; ``u (N,)`` in [0, 1): which curve and where on it. The others are not needed."""
        index, rest = self.choice.draw(u)
        pieces = rows(self.pieces, index)
        t, density = pieces.place(rest)
        held, p, along = pieces.curves.moving(self.bodies, t)
        lane, density = torch.arange(len(u), device=u.device), density * take(self.choice.pmf, index)
        curves = pieces.curves
        return EdgePoints(lane, held, curves.mate, curves.cut, curves.bent, p, along, density)


@dataclass(frozen=True)
class SeenThroughLens:
    """Draws places of edges as points of a lens see them.

    Attributes:
        occluders: all edges.
        choice: among them.
    """

    occluders: Occluders
    choice: Distribution1D

    def draw(self, u: Tensor, coin: Tensor, lens: Tensor | None) -> EdgePoints:
        """Return points for some lanes.

        Args:
            u: ``(N,)`` in [0, 1), which curve and where on it.
            coin: ``(N,)`` in [0, 1): which of two lines.
            lens: ``(2, N)`` samples of the lens.
        """
        camera = self.occluders.bodies.camera
        o, _ = camera.rays(torch.zeros_like(u), torch.zeros_like(u), lens)
        drawn = self.occluders.points(self.choice, u, coin, View(o, torch.ones_like(u)))
        seen = self.occluders.bodies.film.of(drawn.p, rows(lens, drawn.lane))
        return rows(drawn, (seen[2] > 0).nonzero().squeeze(1))


@dataclass(frozen=True)
class Primary:
    """The estimator of one render.

    Attributes:
        bodies: detached.
        source: draws places of edges.
        cuts: True: surfaces cut somewhere.
        traced: what sees, and draws.
    """

    bodies: Bodies
    source: Seen | SeenThroughLens
    cuts: bool
    traced: Traced

    @torch.no_grad()
    def samples(self, first: int, count: int, total: int, worth: Worth, look: Look, over: bool = False) -> Along:
        """Return samples ``first .. first + count`` of ``total``: those that are seen.

        ``over``: they count as they move over what is seen on both sides, which is held in place.
        """
        number, key, u, coin = self.traced.edges(Round(0, total), first, count, Use.PRIMARY)
        lens = self.traced.lens(key)
        place = self.source.draw(u, coin, lens)
        lens = rows(lens, place.lane)
        s, jacobian = self.bodies.film.slopes(place.p, lens)
        slope = (jacobian * place.along).sum(1)
        normal = torch.stack((slope[1], -slope[0]))  # as long as `s` changes with the curve's parameter
        length, value = (normal * normal).sum(0).sqrt(), worth.at(s)
        index = ((length > 0) & (value != 0).any(0)).nonzero().squeeze(1)
        place, lens, s, normal, length, value = rows((place, lens, s, normal, length, value), index)
        step = steps_at(self.bodies, (place.held.prim, place.mate), s, lens)
        o, d = self._beside(s, lens, normal / length, step)
        key = take(key, place.lane)
        share = self._share(place, s, lens, step, o, d, key)
        if self.cuts:
            share = share * self._visible_nearby(place, s, lens, key)
        seen = (share > 0).nonzero().squeeze(1)
        both = torch.cat((seen, seen + len(index)))
        half = s, lens, normal / length, 0.25 * step
        place, lens, normal, value, share = rows((place, lens, normal, value, share), seen)
        o, d = take(o, both), take(d, both)
        n = len(seen)
        number = take(number, place.lane)
        values = look(o, d, number.repeat(2)) if n else torch.zeros(len(value), 0).to(value)
        bent = (place.bent & ~place.cut).nonzero().squeeze(1)
        if len(bent):  # radiance beside outlines changes with the root of the step: two steps give what is at none
            near = look(*self._beside(*rows(half, take(seen, bent))), take(number, bent).repeat(2))
            bent = torch.cat((bent, bent + n))
            values[:, bent] = 2.0 * near - values[:, bent]
        jump = values[:, :n] - values[:, n:]
        worthy = (value * jump).sum(0) * share
        chance = place.density * total
        beside = None
        if over:
            each = (value.repeat(1, 2) * values).sum(0) * (share / chance).repeat(2)
            each = torch.cat((each[:n], -each[n:]))
            t, prim = self.traced.nearest(o, d)
            met = prim >= 0
            beside = torch.where(met, o, torch.inf), torch.where(met, t, 1.0) * d, normal.repeat(1, 2) * each
        crossing = crossing_of(self.bodies, place.cut, place.held, place.mate)
        return Along(place.held, normal * (worthy / chance), lens, crossing, beside)

    def _beside(self, s: Tensor, lens: Tensor | None, unit: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Return rays through the film a step beside places, before their curves' normals and behind: ``(3, 2 N)``."""
        places = torch.cat((s - unit * step, s + unit * step), 1)
        lens = None if lens is None else lens.repeat(1, 2)
        o, d = self.bodies.film.rays(places, lens)
        return o.expand_as(d), d

    def _share(
        self, place: EdgePoints, s: Tensor, lens: Tensor | None, step: Tensor, o: Tensor, d: Tensor, key: Tensor
    ) -> Tensor:
        """Return how much of each edge counts ``(N,)``: nothing where it is hidden, a part where others lie on it."""
        n = place.p.shape[1]
        away = place.p - o[:, :n]
        reach = (away * d[:, :n]).sum(0)
        t, prim = self.traced.nearest(o, d, _ending_at(reach.repeat(2), _BEFORE, key.repeat(1, 2)))
        t, prim = t.view(2, n), prim.view(2, n)
        own = (prim == place.held.prim) | ((prim == place.mate) & (place.mate >= 0))
        # Of all edges that lie on one line of the film those count whose surface is seen beside it.
        seen = ((t > reach * torch.where(own, _OWN, _BEFORE)) | (own & place.bent)).all(0) & own.any(0)
        near = (t - reach).abs() < reach * 2.0**-8
        return torch.where(seen, share_of(self.bodies, place, s, lens, prim, near, step), 0.0)

    def _visible_nearby(self, place: EdgePoints, s: Tensor, lens: Tensor | None, key: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of edges that are not hidden close to them, by a surface that cuts through theirs.

        A step beside an edge tells this too late: behind its outline a round surface comes forward by the root of the step, so
        that a ray beside an outline below a floor meets what stands out of the floor.
        """
        o, d = self.bodies.film.rays(s, lens)
        o = o.expand_as(d)
        reach = ((place.p - o) * d).sum(0)
        t, prim = self.traced.nearest(o, d, _ending_at(reach, _NEAR, key))
        # An outline may be met a little before, or missed.
        outline = ~place.cut & ((prim == place.held.prim) | (prim == place.mate))
        return (t > reach * _NEAR) | outline


def _ending_at(reach: Tensor, near: float, key: Tensor) -> Passing:
    """Return what lets rays pass all that is not opaque before places ``reach (N,)`` away, and nothing from there on."""
    return Passing(key, depth=1, free=reach * near, stop=torch.zeros_like(reach))


def primary_of(
    scene: Scene,
    bodies: Bodies,
    poses: dict[str, Tensor],
    traced: Traced,
    bounds: Bounds,
    cuts: Cuts | None,
    moves: Tensor | None,
) -> Primary | None:
    """Return the estimator; None where the camera sees no edge that moves. Arguments are as for :func:`pieces_of`."""
    if bodies.camera.lens:
        every = marked_primitives(scene, lambda _: True) if moves is None else moves
        occluders = occluders_of(scene, bodies, poses, every, cuts, lights_move=False)
        if occluders is None or occluders.seen is None:
            return None
        return Primary(bodies, SeenThroughLens(occluders, occluders.seen), cuts is not None, traced)
    pieces = pieces_of(scene, bodies, poses, bounds, cuts, moves)
    if pieces is None:
        return None
    choice = Distribution1D.of(pieces.weight, torch.float64, even=0.0)
    return Primary(bodies, Seen(bodies, pieces, choice), cuts is not None, traced)
