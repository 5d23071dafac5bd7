"""Edges in light that surfaces reflect: boundary segments, sampled from the edge.

Seen from a receiver x, the light that surfaces reflect jumps along curves of directions. With e on a curve of tangent ``τ``,
``ω`` the direction from e to x, ``m`` the unit vector across ``ω`` and ``τ``, and ``r = |e - x|``, the measure of receivers
and of angles along the curve is one of places on the edge and of directions there::

    cos_x dA_x dψ / r  =  |τ × ω| dl dω       edges; l is the length
                       =  κ(ω) dA_p dφ        outlines of round surfaces: any point p, any tangent ω at angle φ

with ``κ`` the normal curvature along ``ω``; there ``m`` is the normal. So the weight is bounded, and no receiver is chosen:
it is what the ray from e along ``ω`` meets. The derivative of the loss is the integral of::

    W(x) cos_s/cos_g Σ_± -(±) [c - (1 - a_±) d_±] L_±,     c = m·(V(e) - V(x)),  d_± = m·(V(y_±) - V(x)) r / r_±

where ``y_±`` is what the ray from x beside e meets at ``r_±``, ``L_±`` the light that it reflects, and ``a_±`` the share by
which it slides (:mod:`torchpt.gradients.edges.receivers`). On the edge's own surface ``d = c``, and a part ``a`` of it
counts: creases, borders, contacts and silhouettes are one formula, without a test for silhouettes.

Light of lights themselves, whose points are all held, and light of the sky are in :mod:`torchpt.gradients.edges.shadows`,
which aims at lights.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.curves import (
    Curves,
    Rounds,
    folds_of,
    joined,
    marked_primitives,
    parts_of,
    plain_of,
    rounds_of,
)
from torchpt.gradients.edges.receivers import LONGEST, ROUNDING, Frame, Prefix, held_at, prefixes_of
from torchpt.gradients.edges.shadows import STILL
from torchpt.gradients.edges.traced import Use
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.sampling import Distribution1D, uniform_sphere, uniform_triangle
from torchpt.math.vectors import Frame as Basis
from torchpt.math.vectors import concatenate_lanes, cross, dot, largest, normalize, rows, take
from torchpt.physics.samplers import Dimension
from torchpt.physics.shapes.quadrics import Form
from torchpt.scene import Scene

__all__ = ["SegmentSamples", "Segments", "segments_of"]

#: Rays go so far beside an edge, against the way to it, beyond the rounding.
_STEP = 2.0**-16
#: What ends so close to an edge, against the way to it, ends at it.
_NEAR = 2.0**-10
#: Least weight of a crease against a border of the same length.
_CREASE = 0.1
#: Faces at an angle below this make no edge.
_PLAIN = 1e-6
#: Part of the directions that are drawn toward points of surfaces shaded smooth, where there are any.
_TOWARD = 0.5


# ---- What segments begin at


@dataclass(frozen=True)
class Starts:
    """Places of edges with directions, N lanes.

    Attributes:
        held: the places.
        mate: the other face at each; -1: there is none.
        e: where they are ``(3, N)``.
        tangent: of the edge ``(3, N)``, unit.
        out: normals of round surfaces ``(3, N)``; 0 on edges.
        curvature: ``(N,)`` of round surfaces along ``omega``; 0 on edges.
        omega: unit directions ``(3, N)``.
        density: ``(N,)`` of ``omega`` by solid angle; 1 where ``weight`` has it.
        target: ``(3, N)`` points toward which directions were drawn.
        aimed: ``(N,)`` bool: they were.
        weight: ``(N,)`` the measure over the density of the place.
    """

    held: Held
    mate: Tensor
    e: Tensor
    tangent: Tensor
    out: Tensor
    curvature: Tensor
    omega: Tensor
    density: Tensor
    target: Tensor
    aimed: Tensor
    weight: Tensor


@dataclass(frozen=True)
class Smooth:
    """Faces that are shaded smooth: directions are drawn toward them, as the cosine of their shading has no bound there.

    Attributes:
        prim: ids ``(S,)``.
        choice: of a face, by area.
        area: of all.
        mask: ``(P,)`` bool: which of all primitives they are.
    """

    prim: Tensor
    choice: Distribution1D
    area: float
    mask: Tensor

    def draw(self, bodies: Bodies, u: Tensor) -> Held:
        """Return points ``(N,)``, evenly by area; ``u (2, N)``."""
        index, rest = self.choice.draw(u[0])
        place = uniform_triangle(torch.stack((rest, u[1])))
        return Held(take(self.prim, index), torch.cat((place, torch.zeros_like(place[:1]))))


@dataclass(frozen=True)
class Brinks:
    """Edges and round surfaces along whose outlines light jumps.

    Attributes:
        bodies: detached.
        curves: E edges that are known; None: there are none.
        others: corners off the edges, of both faces.
        folded: ``(E,)`` bool: edges of two faces.
        part: ``(E,)`` with which edges count where others lie on them.
        rounds: R round surfaces by kind.
        choice: of the E edges, then of the R surfaces.
        smooth: faces that are shaded smooth; None: there are none.
    """

    bodies: Bodies
    curves: Curves | None
    others: tuple[Held, Held]
    folded: Tensor
    part: Tensor
    rounds: list[Rounds]
    choice: Distribution1D
    smooth: Smooth | None

    def draw(self, u: Tensor, direction: Tensor, aim: Tensor, coins: Tensor) -> Starts:
        """Draw places and directions.

        Args:
            u: ``(N,)`` where on the edges.
            direction: ``(2, N)``.
            aim: ``(2, N)`` of points toward which directions go.
            coins: ``(2, N)`` how the direction is drawn.
        """
        index, rest = self.choice.draw(u)
        chance = take(self.choice.pmf, index)
        count = 0 if self.curves is None else len(self.curves.prim)
        lanes, parts = [], []

        def add(first: int, end: int, make: Callable[..., Starts], *given: Any) -> None:
            lane = ((index >= first) & (index < end)).nonzero().squeeze(1)
            if len(lane):
                lanes.append(lane)
                parts.append(
                    make(
                        take(index, lane) - first,
                        *given,
                        *(take(x, lane) for x in (rest, chance, direction, aim, coins)),
                    )
                )

        add(0, count, self._edges)
        for rounds in self.rounds:
            add(count, count + len(rounds.prim), self._rounds, rounds)
            count += len(rounds.prim)
        return rows(concatenate_lanes(parts), torch.argsort(torch.cat(lanes)))

    def _edges(
        self, index: Tensor, rest: Tensor, chance: Tensor, direction: Tensor, aim: Tensor, coins: Tensor
    ) -> Starts:
        """Places on edges, and directions: evenly, where both faces lie to one side, and toward smooth faces."""
        assert self.curves is not None
        part = rows(self.curves, index)
        span = part.high - part.low
        held, e, along = part.moving(self.bodies, part.low + rest * span)
        length = dot(along, along).sqrt()
        tangent = along / length
        # Axes across the edge, the first in the first face; the second face is at an angle of beta.
        one, other = (self._across(rows(face, index), e, tangent) for face in self.others)
        cosine = dot(one, other).clamp(-1.0, 1.0)
        bend = other - one * cosine
        plain = dot(bend, bend) < _PLAIN * _PLAIN
        two = normalize(torch.where(plain, cross(tangent, one), bend))
        beta = torch.acos(cosine)
        # At so many angles, and as many opposite ones, both faces lie to one side.
        wedge = math.pi - beta
        folded = take(self.folded, index) & ~plain & (wedge > _PLAIN)
        wedge = torch.where(folded, wedge, 1.0)
        angle = 2.0 * math.pi * direction[1]
        within = folded & (coins[0] < 0.5)
        angle = torch.where(within, beta + 2.0 * wedge * direction[1], angle)
        angle = torch.where(within & (direction[1] >= 0.5), angle - wedge + math.pi, angle)
        lengthwise = 2.0 * direction[0] - 1.0
        crosswise = (1.0 - lengthwise * lengthwise).clamp_min(0.0).sqrt()
        omega = tangent * lengthwise + (one * torch.cos(angle) + two * torch.sin(angle)) * crosswise
        target, aimed = e, torch.zeros_like(folded)
        if self.smooth is not None:
            aimed = coins[1] < _TOWARD
            target = torch.where(aimed, self.bodies.points(self.smooth.draw(self.bodies, aim)), e)
            away = target - e
            size = dot(away, away).sqrt()
            aimed = aimed & (size > 0)
            omega = torch.where(aimed, away / torch.where(size > 0, size, 1.0), omega)
        angle = torch.remainder(torch.atan2(dot(omega, two), dot(omega, one)), math.pi)
        even = torch.where(folded, 0.25, 0.5) / math.pi
        density = 0.5 * (even + torch.where(folded & (angle >= beta), 0.25 / wedge, 0.0))
        zero = torch.zeros_like(e)
        weight = length * span * take(self.part, index) / chance
        return Starts(held, part.mate, e, tangent, zero, zero[0], omega, density, target, aimed, weight)

    def _across(self, face: Held, e: Tensor, tangent: Tensor) -> Tensor:
        """Unit vectors in faces ``(3, N)``, across their edges."""
        away = self.bodies.points(face) - e
        away = away - tangent * dot(tangent, away)
        length = dot(away, away).sqrt()
        return torch.where(length > 0, away / torch.where(length > 0, length, 1.0), Basis.about(tangent).s)

    def _rounds(
        self, index: Tensor, rounds: Rounds, rest: Tensor, chance: Tensor, direction: Tensor, aim: Tensor, coins: Tensor
    ) -> Starts:
        """Places on round surfaces, evenly in their own space, and directions along them."""
        prim, form = take(rounds.prim, index), rounds.form
        a, gradient, size = _place(form, torch.stack((rest, direction[0])))
        p0, *axes = self.bodies.place(prim)
        e = p0 + axes[0] * a[0] + axes[1] * a[1] + axes[2] * a[2]
        faces = [cross(axes[1], axes[2]), cross(axes[2], axes[0]), cross(axes[0], axes[1])]
        det = dot(axes[0], faces[0])
        normal = (faces[0] * gradient[0] + faces[1] * gradient[1] + faces[2] * gradient[2]) / det
        steep = dot(normal, normal).sqrt()  # the slope of the surface's equation in the world
        normal = normal / steep
        area = size * det.abs() * steep / dot(gradient, gradient).sqrt()
        basis, angle = Basis.about(normal), 2.0 * math.pi * direction[1]
        omega = basis.s * torch.cos(angle) + basis.t * torch.sin(angle)
        own = torch.stack([dot(face, omega) / det for face in faces]).square()
        curvature = (own[0] + own[1] + (1.0 if form is None else form.bend) * own[2]).abs() / steep
        weight = curvature * area * (2.0 * math.pi) / chance
        none, one = torch.full_like(prim, -1), torch.ones_like(weight)
        return Starts(Held(prim, a), none, e, basis.s, normal, curvature, omega, one, e, none >= 0, weight)


def _place(form: Form | None, u: Tensor) -> tuple[Tensor, Tensor, float]:
    """Return places on round surfaces, half the gradient of their equation, and their area, in their own space.

    Places and gradients are ``(3, N)``. Places are even by area.
    """
    if form is None:
        q = uniform_sphere(u)
        return q, q, 4.0 * math.pi
    cos, sin = torch.cos(2.0 * math.pi * u[0]), torch.sin(2.0 * math.pi * u[0])
    if form.bend < 0:  # a cone with its tip at z = 1
        r = u[1].sqrt()
        return torch.stack((r * cos, r * sin, 1.0 - r)), torch.stack((r * cos, r * sin, r)), math.pi * math.sqrt(2.0)
    return torch.stack((cos, sin, u[1])), torch.stack((cos, sin, torch.zeros_like(cos))), 2.0 * math.pi


def brinks_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor], moves: Tensor) -> Brinks | None:
    """Return all edges and round surfaces, by length; None where there are none.

    Args:
        scene: the scene.
        bodies: detached.
        poses: the parameters.
        moves: ``(P,)`` bool: primitives that move.
    """
    curves, others, folded, weights = [], [], [], []

    def add(part: Curves, faces: tuple[Held, Held], folds: Tensor, share: Tensor | float) -> None:
        _, _, along = part.moving(bodies, 0.5 * (part.low + part.high))
        moving = take(moves, part.prim) | ((part.mate >= 0) & take(moves, part.mate.clamp_min(0)))
        length = dot(along, along).sqrt() * (part.high - part.low)
        curves.append(part)
        others.append(faces)
        folded.append(folds)
        weights.append(length * torch.where(moving, 1.0, STILL) * share)

    for folds in folds_of(scene, bodies, poses):
        apart = folds.normals[0] - folds.normals[1]
        bend = dot(apart, apart).sqrt()
        share = torch.where(folds.border, 1.0, torch.where(bend > _PLAIN, bend.clamp(_CREASE, 1.0), 0.0))
        add(folds.curves, folds.others, ~folds.border, share)
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        own = Held(fixed.prim, fixed.at(fixed.low)[0].a)
        add(fixed, (own, own), torch.zeros_like(fixed.round), 1.0)
    rounds = rounds_of(scene, bodies)
    for some in rounds:
        _, *axes = bodies.place(some.prim)
        size = sum((dot(axis, axis).sqrt() for axis in axes), torch.zeros_like(axes[0][0]))
        weights.append(2.0 * size * torch.where(take(moves, some.prim), 1.0, STILL))
    if not weights or not bool((torch.cat(weights) > 0).any()):
        return None
    every = joined(curves) if curves else None
    part = torch.zeros(0, dtype=torch.float64, device=scene.device)
    if every is not None:  # of those that are drawn at all
        drawn = (torch.cat(weights[: len(curves)]) > 0).nonzero().squeeze(1)
        part = torch.ones_like(every.low).index_copy(0, drawn, parts_of(bodies, rows(every, drawn)))
    firsts, seconds = ([pair[k] for pair in others] for k in range(2))
    zero = Held(torch.zeros(0, dtype=torch.int64), torch.zeros(3, 0, dtype=torch.float64))
    return Brinks(
        bodies,
        every,
        (concatenate_lanes(firsts), concatenate_lanes(seconds)) if others else (zero, zero),
        torch.cat(folded) if folded else part > 0,
        part,
        rounds,
        Distribution1D.of(torch.cat(weights), torch.float64, even=0.0),
        smooth_of(scene, bodies),
    )


def smooth_of(scene: Scene, bodies: Bodies) -> Smooth | None:
    """Return the faces that are shaded smooth, those of copies too; None where there are none."""
    mask = marked_primitives(scene, lambda part: part.kind == "triangle" and part.smooth)
    if not bool(mask.any()):
        return None
    prim = mask.nonzero().squeeze(1)
    _, x, y, _ = bodies.place(prim)
    n = cross(x, y)
    area = 0.5 * dot(n, n).sqrt()
    return Smooth(prim, Distribution1D.of(area, torch.float64, even=0.0), float(area.sum()), mask)


# ---- Samples


@dataclass(frozen=True)
class Side:
    """What receivers see beside the edge, N lanes.

    Attributes:
        sign: of the side.
        held: the points.
        r: ``(N,)`` how far they are.
        share: ``(N,)`` by which they slide.
    """

    sign: float
    held: Held
    r: Tensor
    share: Tensor


@dataclass(frozen=True)
class SegmentSamples:
    """Samples of segments; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        edge: the places on edges.
        m: unit vectors across them, as receivers see them ``(3, N)``.
        r: ``(N,)`` from the receivers to the edge.
        sides: what is seen on both sides.
        seen: prefixes of the receivers, each with the light ``(2, M)`` from both sides.
    """

    edge: Held
    m: Tensor
    r: Tensor
    sides: list[Side]
    seen: list[tuple[Prefix, Tensor]]

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        value = torch.zeros((), dtype=self.r.dtype, device=self.r.device)
        e = dot(self.m, bodies.points(self.edge))
        ends = [dot(self.m, bodies.points(side.held)) for side in self.sides]
        for prefix, light in self.seen:
            lane = prefix.lane
            x = dot(take(self.m, lane), prefix.receivers(bodies))
            c = take(e, lane) - x
            for side, end, arrives in zip(self.sides, ends, light, strict=True):
                d = (take(end, lane) - x) * take(self.r / side.r, lane)
                value = value - side.sign * ((c - (1.0 - take(side.share, lane)) * d) * arrives).sum()
        return value


@dataclass(frozen=True)
class Segments:
    """The estimator of one render.

    Attributes:
        frame: of the interior.
        brinks: what segments begin at.
        depth: vertices of paths at most; -1: any number.
    """

    frame: Frame
    brinks: Brinks
    depth: int

    @torch.no_grad()
    def samples(self, first: int, count: int, total: int) -> SegmentSamples | None:
        """Return samples ``first .. first + count`` of ``total``; None where none of them counts."""
        traced, bodies = self.frame.traced, self.frame.bodies
        number = torch.arange(first, first + count, device=bodies.p0.device)
        key = traced.key(number, Use.REFLECTED)
        u, coin = traced.edge(number, key, total)
        draws = traced.draws(key)
        direction, aim = draws.two(Dimension.BSDF).double(), draws.two(Dimension.LIGHT).double()
        starts = self.brinks.draw(u, direction, aim, torch.stack((coin, draws.one(Dimension.LOBE).double())))
        starts, spot, lane = self._arrived(starts)
        if not len(lane):
            return None
        number, key = take(number, lane), take(key, lane)
        return self._between(starts, spot, number, key, total)

    def _rounding(self, *points: Tensor) -> Tensor:
        """Return the rounding of points that the search finds ``(N,)``."""
        largest_of = torch.stack([largest(p.abs()) for p in points]).amax(0)
        return largest_of * ROUNDING

    def _size(self, prim: Tensor) -> Tensor:
        """Return the largest coordinates of primitives ``(3, N)``."""
        p0, *axes = self.frame.bodies.place(prim)
        return p0.abs() + sum((axis.abs() for axis in axes), torch.zeros_like(p0))

    def _arrived(self, starts: Starts) -> tuple[Starts, Spot, Tensor]:
        """Return the starts whose rays meet a receiver, the receivers, and which lanes these are."""
        tiny = self._rounding(self._size(starts.held.prim))
        lift = (starts.omega + starts.out) * (4.0 * tiny)
        spot = met(self.frame.traced, starts.e + lift, starts.omega)
        p, n, prim = spot.p.double(), spot.n.double(), spot.hit.prim
        away = p - starts.e
        r = dot(away, away).sqrt()
        density = starts.density
        smooth = self.brinks.smooth
        good = (prim >= 0) & (r > 16.0 * torch.maximum(tiny, self._rounding(p)))
        if smooth is not None:
            mine = take(smooth.mask, prim.clamp_min(0)) & (prim >= 0)
            toward = r * r / (dot(n, starts.omega).abs().clamp_min(1e-12) * smooth.area)
            mixed = (1.0 - _TOWARD) * density + torch.where(mine, _TOWARD * toward, 0.0)
            density = torch.where(starts.curvature > 0, density, mixed)
            off = p - starts.target
            hits = dot(off, off).sqrt() < 1e-3 * r + 8.0 * tiny
            good &= ~starts.aimed | (mine & hits)
        lane = good.nonzero().squeeze(1)
        starts = replace(starts, density=density)
        return rows(starts, lane), spot.taken(lane), lane

    def _between(self, starts: Starts, spot: Spot, number: Tensor, key: Tensor, total: int) -> SegmentSamples | None:
        """Return the samples of starts and the receivers that they met."""
        x, n = spot.p.double(), spot.n.double()
        n = n * -torch.sign(dot(n, starts.omega))
        round_ = starts.curvature > 0
        side = cross(starts.tangent, starts.omega)
        size = dot(side, side).sqrt()
        m = torch.where(round_, starts.out, side / torch.where(size > 0, size, 1.0))
        weight = torch.where(round_, 1.0, size) * starts.weight / (starts.density * total)
        tiny = self._rounding(x, starts.e, self._size(starts.held.prim))
        o = x + n * tiny
        way = starts.e - o
        r = dot(way, way).sqrt()
        step = r * _STEP + tiny
        ok = (r > 16.0 * tiny) & (weight > 0) & torch.isfinite(weight)
        spots, sides = [], []
        for sign in (1.0, -1.0):
            y = met(self.frame.traced, o, way + m * (step * sign))
            prim = y.hit.prim
            reach = torch.where(prim >= 0, y.hit.t.double(), r)
            touches = dot(y.n.double(), starts.e - y.p.double()).abs() < 6.0 * step
            ahead = torch.where(
                round_ & (prim == starts.held.prim), 12.0 * (step / starts.curvature.clamp_min(1e-3)).sqrt(), r * _NEAR
            )
            ok &= (prim < 0) | (reach > r - ahead) | touches
            held = held_at(self.frame.bodies, prim.clamp_min(0), torch.stack((y.hit.u, y.hit.v)), y.p.double())
            spots.append(y)
            sides.append(Side(sign, held, reach, torch.where(prim >= 0, self.frame.share(prim, r=reach), 1.0)))
        lane = ok.nonzero().squeeze(1)
        if not len(lane):
            return None
        starts, spot, number, key = rows(starts, lane), spot.taken(lane), take(number, lane), take(key, lane)
        m, r, weight, o = take(m, lane), take(r, lane), take(weight, lane), take(o, lane)
        sides, spots = [rows(side, lane) for side in sides], [y.taken(lane) for y in spots]
        moves = self.frame.moving(starts.held.prim) | self.frame.moving(starts.mate)
        for y in spots:
            moves = moves | self.frame.moving(y.hit.prim)
        longest = (self.depth if self.depth >= 0 else LONGEST) - 2
        seen = []
        for prefix in prefixes_of(self.frame, spot, -starts.omega, key, longest):
            some = (prefix.moves() | take(moves, prefix.lane)).nonzero().squeeze(1)
            if not len(some):
                continue
            prefix = prefix.taken(some)
            depth = self.depth if self.depth < 0 else self.depth - prefix.count
            light = [self._reflected(y, o, number, prefix.lane, depth) for y in spots]
            scale = prefix.weight * take(weight, prefix.lane)
            seen.append((prefix, torch.stack([(scale * part).sum(0) for part in light])))
        return SegmentSamples(starts.held, m, r, sides, seen) if seen else None

    def _reflected(self, spot: Spot, o: Tensor, number: Tensor, lane: Tensor, depth: int) -> Tensor:
        """Return the light ``(3, M)`` that what was met in lanes ``(M,)`` reflects, along paths of so many vertices."""
        found = torch.zeros(3, len(lane), dtype=torch.float64, device=lane.device)
        some = (take(spot.hit.prim, lane) >= 0).nonzero().squeeze(1)
        if not len(some):
            return found
        mine = take(lane, some)
        rays = take(o, mine), take(spot.d, mine).double(), take(number, mine), Use.BEHIND
        radiance = self.frame.traced.radiance
        found[:, some] = radiance(*rays, depth) - radiance(*rays, 1)  # without light of sources themselves
        return found


def segments_of(scene: Scene, frame: Frame, poses: dict[str, Tensor], depth: int) -> Segments | None:
    """Return the estimator; None where no light is reflected past edges.

    Args:
        scene: the scene.
        frame: of the interior.
        poses: the parameters.
        depth: vertices of paths at most; -1: any number.
    """
    if 0 <= depth < 3:
        return None
    brinks = brinks_of(scene, frame.bodies, poses, frame.moves)
    return None if brinks is None else Segments(frame, brinks, depth)
