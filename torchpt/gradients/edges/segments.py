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
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.curves import smooth_faces
from torchpt.gradients.edges.cuts import Crossing, crossing_of
from torchpt.gradients.edges.occluders import Occluders
from torchpt.gradients.edges.receivers import MovingFrame, Prefix, one_of_each, prefixes_of
from torchpt.gradients.edges.traced import Passing, Use
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.guiding import Round
from torchpt.math.sampling import Distribution1D, uniform_sphere, uniform_triangle
from torchpt.math.vectors import Frame, concatenate_lanes, cross, dot, normalize, rows, take
from torchpt.physics.samplers import Dimension
from torchpt.physics.shapes.quadrics import Form
from torchpt.scene import Scene

__all__ = ["SegmentRays", "SegmentSampler", "SegmentSamples", "Segments", "smooth_of"]

#: Rays go so far beside an edge, against the way to it, beyond the rounding.
_STEP = 2.0**-16
#: What ends so close to an edge, against the way to it, ends at it.
_NEAR = 2.0**-10
#: Faces at an angle below this have no directions from which both lie to one side.
_PLAIN = 1e-6
#: Points of faces that are closer to the edge, against their distance from its point, lie on it but for rounding.
_OFF = 1e-6
#: Part of the directions that are drawn toward points of surfaces shaded smooth, where there are any.
_TOWARD = 0.5


# ---- Rays from edges to receivers


@dataclass(frozen=True)
class SegmentRays:
    """Points of edges with directions toward receivers, N lanes.

    Attributes:
        held: the points.
        mate: the other face at each; -1: there is none.
        cut: ``(N,)`` bool: the two cut there.
        e: where they are ``(3, N)``.
        out: normals of round surfaces ``(3, N)``; 0 on edges.
        curvature: ``(N,)`` of round surfaces along ``omega``; 0 on edges.
        omega: unit directions ``(3, N)``.
        density: ``(N,)`` of ``omega`` by solid angle; 1 where ``weight`` has it.
        aimed: ``(N,)`` faces toward which directions were drawn; -1: none.
        m: ``(3, N)`` unit vectors across both the edge and ``omega``.
        weight: ``(N,)`` the measure over the density of the point.
    """

    held: Held
    mate: Tensor
    cut: Tensor
    e: Tensor
    out: Tensor
    curvature: Tensor
    omega: Tensor
    density: Tensor
    aimed: Tensor
    m: Tensor
    weight: Tensor


@dataclass(frozen=True)
class Smooth:
    """Faces that are shaded smooth: directions are drawn toward them, as the cosine of their shading has no bound there.

    Attributes:
        prim: ids ``(S,)``.
        choice: of a face, by area.
        area: of all.
    """

    prim: Tensor
    choice: Distribution1D
    area: float

    def draw(self, u: Tensor) -> Held:
        """Return points ``(N,)``, evenly by area; ``u (2, N)``."""
        index, rest = self.choice.draw(u[0])
        place = uniform_triangle(torch.stack((rest, u[1])))
        return Held(take(self.prim, index), torch.cat((place, torch.zeros_like(place[:1]))))


@dataclass(frozen=True)
class CurveSample:
    """Curves and random numbers of N rays.

    Attributes:
        index: of the curves ``(N,)``.
        rest: ``(N,)`` where on them, in [0, 1).
        chance: ``(N,)`` of the curves.
        direction: ``(2, N)``.
        aim: ``(2, N)`` of points toward which directions go.
        coins: ``(2, N)`` how directions are drawn.
    """

    index: Tensor
    rest: Tensor
    chance: Tensor
    direction: Tensor
    aim: Tensor
    coins: Tensor


@dataclass(frozen=True)
class SegmentSampler:
    """Draws points of edges and of round surfaces, and directions.

    Attributes:
        occluders: the edges and round surfaces.
        smooth: faces that are shaded smooth; None: there are none.
    """

    occluders: Occluders
    smooth: Smooth | None

    def draw(self, u: Tensor, direction: Tensor, aim: Tensor, coins: Tensor) -> SegmentRays:
        """Draw rays.

        Args:
            u: ``(N,)`` where on the edges.
            direction: ``(2, N)``.
            aim: ``(2, N)`` of points toward which directions go.
            coins: ``(2, N)`` how the direction is drawn.
        """
        index, rest = self.occluders.creases.draw(u)
        sample = CurveSample(index, rest, take(self.occluders.creases.pmf, index), direction, aim, coins)
        form = take(self.occluders.form, index)
        lanes, parts = [], []
        for number in range(-1, len(self.occluders.forms) + 1):
            lane = (form == number).nonzero().squeeze(1)
            if not len(lane):
                continue
            lanes.append(lane)
            mine = rows(sample, lane)
            if number < 0:
                parts.append(self._edges(mine))
            else:
                parts.append(self._rounds(mine, self.occluders.forms[number - 1] if number else None))
        return rows(concatenate_lanes(parts), torch.argsort(torch.cat(lanes)))

    def _edges(self, sample: CurveSample) -> SegmentRays:
        """Draw points of edges, and directions: evenly, where both faces lie to one side, and toward smooth faces."""
        index, direction, coins = sample.index, sample.direction, sample.coins
        bodies, part = self.occluders.bodies, rows(self.occluders.curves, index)
        span = part.high - part.low
        held, e, along = part.moving(bodies, part.low + sample.rest * span)
        length = dot(along, along).sqrt()
        tangent = along / length
        # Axes across the edge, the first in the first face; the second face is at an angle of beta.
        one, other = (self._across(rows(face, index), e, tangent) for face in self.occluders.others)
        cosine = dot(one, other).clamp(-1.0, 1.0)
        bend = other - one * cosine
        plain = dot(bend, bend) < _PLAIN * _PLAIN
        two = normalize(torch.where(plain, cross(tangent, one), bend))
        beta = torch.acos(cosine)
        # At so many angles, and as many opposite ones, both faces lie to one side.
        wedge = math.pi - beta
        folded = take(self.occluders.folded, index) & ~plain & (wedge > _PLAIN)
        wedge = torch.where(folded, wedge, 1.0)
        angle = 2.0 * math.pi * direction[1]
        within = folded & (coins[0] < 0.5)
        angle = torch.where(within, beta + 2.0 * wedge * direction[1], angle)
        angle = torch.where(within & (direction[1] >= 0.5), angle - wedge + math.pi, angle)
        lengthwise = 2.0 * direction[0] - 1.0
        crosswise = (1.0 - lengthwise * lengthwise).clamp_min(0.0).sqrt()
        omega = tangent * lengthwise + (one * torch.cos(angle) + two * torch.sin(angle)) * crosswise
        aimed = torch.full_like(index, -1)
        if self.smooth is not None:
            target = self.smooth.draw(sample.aim)
            away = bodies.points(target) - e
            size = dot(away, away).sqrt()
            toward = (coins[1] < _TOWARD) & (size > 0)
            omega = torch.where(toward, away / torch.where(toward, size, 1.0), omega)
            aimed = torch.where(toward, target.prim, aimed)
        angle = torch.remainder(torch.atan2(dot(omega, two), dot(omega, one)), math.pi)
        even = torch.where(folded, 0.25, 0.5) / math.pi
        density = 0.5 * (even + torch.where(folded & (angle >= beta), 0.25 / wedge, 0.0))
        side = cross(tangent, omega)
        sine = dot(side, side).sqrt()
        m, zero = side / torch.where(sine > 0, sine, 1.0), torch.zeros_like(e)
        weight = sine * length * span * take(self.occluders.part, index) / sample.chance
        return SegmentRays(held, part.mate, part.cut, e, zero, zero[0], omega, density, aimed, m, weight)

    def _across(self, face: Held, e: Tensor, tangent: Tensor) -> Tensor:
        """Return unit vectors in faces ``(3, N)``, across their edges; any across these where the point lies on the edge."""
        whole = self.occluders.bodies.points(face) - e
        away = whole - tangent * dot(tangent, whole)
        length = dot(away, away).sqrt()
        off = length > _OFF * dot(whole, whole).sqrt()
        return torch.where(off, away / torch.where(off, length, 1.0), Frame.about(tangent).s)

    def _rounds(self, sample: CurveSample, form: Form | None) -> SegmentRays:
        """Draw points of round surfaces, evenly in their own space, and directions along the surfaces."""
        prim = take(self.occluders.curves.prim, sample.index)
        a, gradient, size = _place(form, torch.stack((sample.rest, sample.direction[0])))
        p0, *axes = self.occluders.bodies.place(prim)
        e = p0 + axes[0] * a[0] + axes[1] * a[1] + axes[2] * a[2]
        faces = [cross(axes[1], axes[2]), cross(axes[2], axes[0]), cross(axes[0], axes[1])]
        det = dot(axes[0], faces[0])
        normal = (faces[0] * gradient[0] + faces[1] * gradient[1] + faces[2] * gradient[2]) / det
        steep = dot(normal, normal).sqrt()  # the slope of the surface's equation in the world
        normal = normal / steep
        area = size * det.abs() * steep / dot(gradient, gradient).sqrt()
        basis, angle = Frame.about(normal), 2.0 * math.pi * sample.direction[1]
        omega = basis.s * torch.cos(angle) + basis.t * torch.sin(angle)
        own = torch.stack([dot(face, omega) / det for face in faces]).square()
        curvature = (own[0] + own[1] + (1.0 if form is None else form.bend) * own[2]).abs() / steep
        weight = curvature * area * (2.0 * math.pi) / sample.chance
        none, one = torch.full_like(prim, -1), torch.ones_like(weight)
        return SegmentRays(Held(prim, a), none, none >= 0, e, normal, curvature, omega, one, none, normal, weight)


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


def smooth_of(scene: Scene, bodies: Bodies) -> Smooth | None:
    """Return the faces that are shaded smooth; None where there are none."""
    prim, area = smooth_faces(scene, bodies)
    return Smooth(prim, Distribution1D.of(area, torch.float64, even=0.0), float(area.sum())) if len(prim) else None


# ---- Samples


#: The sides of an edge.
_SIGNS = (1.0, -1.0)


@dataclass(frozen=True)
class Side:
    """The view of receivers beside the edge, N lanes.

    Attributes:
        sign: of the side.
        held: the points.
        r: ``(N,)`` how far they are.
        share: ``(N,)`` by which they slide.
        moves: ``(N,)`` bool: they move.
    """

    sign: float
    held: Held
    r: Tensor
    share: Tensor
    moves: Tensor


@dataclass(frozen=True)
class SegmentSamples:
    """Samples of segments; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        frame: of the interior.
        number: of the samples ``(N,)``.
        edge: the places on edges.
        mate: the other face at each ``(N,)``; -1: there is none.
        m: unit vectors across them, as receivers see them ``(3, N)``.
        r: ``(N,)`` from the receivers to the edge.
        sides: what is seen on both sides.
        prefixes: of the receivers, each with the light ``(2, M)`` from both sides.
        crossing: those of the places where surfaces cut.
    """

    frame: MovingFrame
    number: Tensor
    edge: Held
    mate: Tensor
    m: Tensor
    r: Tensor
    sides: list[Side]
    prefixes: list[tuple[Prefix, Tensor]]
    crossing: Crossing | None

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        cotangents, motions = Cotangents(self.frame.moves), self._motions
        edge = self.m * motions.edge
        cotangents.add_points(self.edge, edge)
        if self.crossing is not None:
            self.crossing.pull_back(cotangents, edge)
        for side, end in zip(self.sides, motions.ends, strict=True):
            cotangents.add_points(side.held, self.m * end)
        for (prefix, _), receivers in zip(self.prefixes, motions.receivers, strict=True):
            prefix.pull_back(cotangents, take(self.m, prefix.lane) * receivers)
        return cotangents.sum(bodies)

    def brought(self) -> Tensor:
        """Return the root of the sum of squares ``(N,)`` of the derivatives by how far edges, receivers and ends move."""
        motions, receivers = self._motions, torch.zeros_like(self.r)
        for (prefix, _), of_prefix in zip(self.prefixes, motions.receivers, strict=True):
            receivers.index_add_(0, prefix.lane, of_prefix.abs() * prefix.motion())
        moves = self.frame.moving(self.edge.prim) | self.frame.moving(self.mate)
        square = moves * motions.edge.square() + receivers.square()
        for side, end in zip(self.sides, motions.ends, strict=True):
            square += side.moves * end.square()
        return square.sqrt()

    @cached_property
    def _motions(self) -> Motions:
        """Return the derivatives of what samples count by motions of what their segments touch."""
        edge, ends, receivers = torch.zeros_like(self.r), [torch.zeros_like(self.r) for _ in self.sides], list[Tensor]()
        turns = [side.sign * (1.0 - side.share) * self.r / side.r for side in self.sides]
        for prefix, light in self.prefixes:
            lane, x = prefix.lane, torch.zeros_like(light[0])
            for side, turn, end, arrives in zip(self.sides, turns, ends, light, strict=True):
                turned = take(turn, lane) * arrives
                end.index_add_(0, lane, turned)
                edge.index_add_(0, lane, arrives, alpha=-side.sign)
                x += side.sign * arrives - turned
            receivers.append(x)
        return Motions(edge, ends, receivers)


@dataclass(frozen=True)
class Motions:
    """Derivatives by motions along ``m``.

    Attributes:
        edge: of edges ``(N,)``.
        ends: of what is seen on both sides ``(N,)``.
        receivers: of the receivers of each prefix ``(M,)``.
    """

    edge: Tensor
    ends: list[Tensor]
    receivers: list[Tensor]


@dataclass(frozen=True)
class Segments:
    """The estimator of one render.

    Attributes:
        frame: of the interior.
        sampler: draws rays from edges to receivers.
        depth: vertices of paths at most; -1: any number.
    """

    frame: MovingFrame
    sampler: SegmentSampler
    depth: int

    @torch.no_grad()
    def samples(self, turn: Round, first: int, count: int) -> SegmentSamples | None:
        """Return samples ``first .. first + count`` of a round; None where none of them counts."""
        traced = self.frame.traced
        number, key, u, coin = traced.edges(turn, first, count, Use.REFLECTED)
        draws = traced.draws(key)
        aim = draws.two(Dimension.LIGHT).double()
        coins = torch.stack((coin, draws.one(Dimension.LOBE).double()))
        u, scale = turn.draw(torch.cat((u[None], draws.two(Dimension.BSDF).double())))
        rays, spot, lane = self._receivers(self.sampler.draw(u[0], u[1:], aim, coins), key)
        found = self._samples(rays, spot, *rows((number, key, scale), lane)) if len(lane) else None
        if turn.memory is not None and found is not None:
            brought = torch.zeros_like(scale).index_add_(0, found.number - number[0], found.brought())
            turn.record(u, scale, brought)
        return found

    def _receivers(self, rays: SegmentRays, key: Tensor) -> tuple[SegmentRays, Spot, Tensor]:
        """Return the rays that meet a receiver, the receivers, and which lanes these are."""
        tiny = self.frame.rounding(rays.held.prim)
        begin = rays.e + (rays.omega + rays.out) * (4.0 * tiny)
        spot = met(self.frame.traced, begin, rays.omega, Passing(key, depth=1))
        p, hits = spot.p.double(), spot.hit.prim >= 0
        away = p - rays.e
        r = dot(away, away).sqrt()
        hits &= r > 16.0 * self.frame.rounding(rays.held.prim, p)
        smooth = self.sampler.smooth
        if smooth is not None:
            shaded = torch.isin(spot.hit.prim, smooth.prim)
            by_area = r * r / (dot(spot.n.double(), rays.omega).abs().clamp_min(1e-12) * smooth.area)
            density = (1.0 - _TOWARD) * rays.density + torch.where(shaded, _TOWARD * by_area, 0.0)
            # The density is that of what is met first: directions to faces behind it count nothing.
            hits &= (rays.aimed < 0) | (rays.aimed == spot.hit.prim)
            rays = replace(rays, density=torch.where(rays.curvature > 0, rays.density, density))
        lane = hits.nonzero().squeeze(1)
        return rows(rays, lane), spot.taken(lane), lane

    def _samples(
        self, rays: SegmentRays, receiver: Spot, number: Tensor, key: Tensor, scale: Tensor
    ) -> SegmentSamples | None:
        """Return the samples of rays and the receivers that they met; None where none of them counts."""
        x, n = receiver.p.double(), receiver.n.double()
        tiny = self.frame.rounding(rays.held.prim, x, rays.e)
        lift = torch.maximum(tiny, self.frame.lift(receiver.hit.prim, n))
        o = x - n * (torch.sign(dot(n, rays.omega)) * lift)
        way = rays.e - o
        r = dot(way, way).sqrt()
        step = r * _STEP + tiny
        weight = rays.weight * scale / rays.density
        counts = (r > 16.0 * tiny) & (weight > 0) & torch.isfinite(weight)
        # The ray to the receiver has decided which surfaces before the edge it passes; paths behind it decide about the others.
        free = r - self._ahead(rays, rays.curvature > 0, r, step)
        passing = self.frame.traced.of_paths(number, Use.BEHIND, free)
        seen = [met(self.frame.traced, o, way + rays.m * (step * sign), passing) for sign in _SIGNS]
        for y in seen:
            counts &= self._ends_at(rays, y, r, step)
        lane = counts.nonzero().squeeze(1)
        if not len(lane):
            return None
        rays, receiver, number, key = rows(rays, lane), receiver.taken(lane), take(number, lane), take(key, lane)
        seen, free, r, weight = [y.taken(lane) for y in seen], take(free, lane), take(r, lane), take(weight, lane)
        moves = self.frame.moving(rays.held.prim) | self.frame.moving(rays.mate)
        for y in seen:
            moves = moves | self.frame.moving(y.hit.prim)
        found = prefixes_of(self.frame, receiver, -rays.omega, key, self.depth, behind=2, moves=moves)
        # Light behind the edge costs more than paths to the camera.
        chosen = one_of_each(found, self.frame.traced.draws(key).one(Dimension.ROULETTE).double())
        if not chosen:
            return None
        depths = [self.depth if self.depth < 0 else self.depth - prefix.count for prefix in chosen]
        light = self._reflected(seen, free, number, [prefix.lane for prefix in chosen], depths)
        prefixes = []
        for prefix in chosen:
            scale = prefix.weight * take(weight, prefix.lane)
            arrives = take(light.view(6, -1), prefix.lane).view(3, 2, -1)
            prefixes.append((prefix, (scale[:, None] * arrives).sum(0)))
        sides = [self._side(sign, y, r) for sign, y in zip(_SIGNS, seen, strict=True)]
        crossing = crossing_of(self.frame.bodies, rays.cut, rays.held, rays.mate)
        return SegmentSamples(self.frame, number, rays.held, rays.mate, rays.m, r, sides, prefixes, crossing)

    def _ends_at(self, rays: SegmentRays, y: Spot, r: Tensor, step: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of rays beside edges that do not end before these, but for what touches there."""
        own = (rays.curvature > 0) & (y.hit.prim == rays.held.prim)
        ahead = self._ahead(rays, own, r, step)
        touches = dot(y.n.double(), rays.e - y.p.double()).abs() < 6.0 * step
        return (y.hit.prim < 0) | (y.hit.t.double() > r - ahead) | touches

    def _ahead(self, rays: SegmentRays, own: Tensor, r: Tensor, step: Tensor) -> Tensor:
        """Return how far before edges ``(N,)`` what ends there ends at them; ``own``: at their own round surfaces.

        These come forward quickly.
        """
        return torch.where(own, 12.0 * (step / rays.curvature.clamp_min(1e-3)).sqrt(), r * _NEAR)

    def _side(self, sign: float, y: Spot, r: Tensor) -> Side:
        """Return what receivers see beside the edge; nothing is as far as the edge."""
        reach = torch.where(y.hit.prim >= 0, y.hit.t.double(), r)
        share, moves = self.frame.share(y.hit.prim, reach), self.frame.moving(y.hit.prim)
        return Side(sign, y.held(self.frame.bodies), reach, share, moves)

    def _reflected(
        self, seen: list[Spot], free: Tensor, number: Tensor, lanes: list[Tensor], depths: list[int]
    ) -> Tensor:
        """Return the light ``(3, 2, N)`` that what was met reflects, by paths of so many vertices.

        Args:
            seen: what was met on both sides.
            free: distances ``(N,)`` before which surfaces that are not opaque let everything pass.
            number: of the samples ``(N,)``.
            lanes: groups of lanes, none of which is in two groups; in others there is no light.
            depths: vertices of paths at most, of each group.
        """
        traced, n = self.frame.traced, len(number)
        o, d = (torch.cat(both, 1) for both in zip(*((y.o, y.d) for y in seen), strict=True))
        prim = torch.cat([y.hit.prim for y in seen])
        if traced.has_opacity:
            t = torch.cat([torch.minimum(free, y.hit.t.double() * (1.0 - _NEAR)) for y in seen])
            o = o.double() + d.double() * t.clamp_min(0.0)
        found = torch.zeros(3, 2 * n, dtype=torch.float64, device=number.device)

        def add(index: Tensor, depth: int, sign: float) -> None:
            if len(index):
                rays = take(o, index), take(d, index).double(), take(number, index % n), Use.BEHIND
                found.index_add_(1, index, traced.radiance(*rays, depth), alpha=sign)

        met_some = []
        for depth in dict.fromkeys(depths):
            same = [lane for lane, of_lane in zip(lanes, depths, strict=True) if of_lane == depth]
            index = torch.cat([lane + side * n for side in range(len(seen)) for lane in same])
            index = take(index, (take(prim, index) >= 0).nonzero().squeeze(1))
            add(index, depth, 1.0)
            met_some.append(index)
        # Without light of sources themselves; where rays pass nothing it is known which of them meet any.
        index = torch.cat(met_some)
        if not traced.has_opacity:
            index = take(index, self.frame.emits(take(prim, index)).nonzero().squeeze(1))
        add(index, 1, -1.0)
        return found.view(3, len(seen), n)
