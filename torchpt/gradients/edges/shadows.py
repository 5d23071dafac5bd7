"""Edges of shadows of lights: what throws them, where they fall, and their share of the gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.cotangents import Cotangents
from torchpt.gradients.edges.curves import View
from torchpt.gradients.edges.occluders import Occluders, OutlinePoints
from torchpt.gradients.edges.receivers import MovingFrame, Prefix, prefixes_of
from torchpt.gradients.edges.traced import Passing, Use
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.guiding import Round
from torchpt.math.sampling import Distribution1D, concentric_disk, uniform_sphere, uniform_triangle
from torchpt.math.vectors import cross, dot, luminance, rows, take
from torchpt.paths.state import T_MAX
from torchpt.paths.vertex import light_radiance
from torchpt.physics.lights import KINDS, SURFACES, from_digits
from torchpt.physics.lights.base import Environment, lane_rows
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import quadrics
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.world import World

__all__ = ["Beam", "Cast", "Shadows", "Sources", "sources_of"]


# ---- Points on lights, drawn for all edges alike: by power, and evenly over a light's surface


@dataclass(frozen=True)
class Beam:
    """Light that may pass edges, N lanes.

    Attributes:
        view: from where it comes.
        held: the point that it leaves; where ``row`` says that it is on a surface.
        row: ``(N,)`` of the table of lights.
        u: ``(2, N)`` of the direction, of environments.
        chance: ``(N,)`` density of the row and, on surfaces, of the place by area.
    """

    view: View
    held: Held
    row: Tensor
    u: Tensor
    chance: Tensor


@dataclass(frozen=True)
class Sources:
    """The lights of a scene as edges draw them.

    Attributes:
        bodies: detached.
        world: the scene's tensors.
        choice: of a row of the table of lights.
        prim: ``(K,)`` the primitive of each row; 0 for those that are no surfaces.
        surfaces: how many rows are surfaces; those come first.
    """

    bodies: Bodies
    world: World
    choice: Distribution1D
    prim: Tensor
    surfaces: int

    def numbers(self, draws: Draws) -> Tensor:
        """Return the numbers ``(2, N)`` float64 of points on lights."""
        u = draws.two(Dimension.LIGHT)
        return torch.stack((from_digits(u[0], draws.one(Dimension.LIGHT_DIGITS)), u[1].double()))

    def draw(self, u: Tensor) -> Beam:
        """Draw points on lights by numbers ``(2, N)``."""
        lights = self.world.lights
        assert lights is not None
        row, rest = self.choice.draw(u[0])
        chance, u = take(self.choice.pmf, row), torch.stack((rest, u[1]))
        a, e, w = torch.zeros(3, len(row), dtype=torch.float64, device=row.device), None, (row < self.surfaces).double()
        prim = take(self.prim, row)
        for k, name in enumerate(lights.kinds):
            mine = self._of(k, row).nonzero().squeeze(1)
            if name in SURFACES and len(mine):
                a[:, mine] = self._place(name, take(prim, mine), take(u, mine))
        held = Held(prim, a)
        e = self.bodies.points(held)
        for k, name in enumerate(lights.kinds):
            mine = self._of(k, row).nonzero().squeeze(1)
            if name in SURFACES or not len(mine):
                continue
            at = lane_rows(lights, take(row, mine) if len(lights.area) > 1 else None)
            if KINDS[name].distant:
                drawn = KINDS[name].sample(
                    at, torch.zeros_like(take(e, mine)).to(at.p0), take(u, mine).to(at.p0), False
                )
                e[:, mine] = drawn.wi.double().expand(3, len(mine))
            else:
                e[:, mine] = at.p0.double().expand(3, len(mine))
                w[mine] = 1.0
        return Beam(View(e, w), held, row, u, chance)

    def _of(self, kind: int, row: Tensor) -> Tensor:
        lights = self.world.lights
        assert lights is not None
        return torch.ones_like(row, dtype=torch.bool) if lights.kind is None else take(lights.kind, row) == kind

    def _place(self, name: str, prim: Tensor, u: Tensor) -> Tensor:
        """Return numbers ``(3, n)`` of places even by area, in a quadric's own space."""
        if name == "quadric":
            assert self.world.geometry.quadrics is not None
            return quadrics.sample(quadrics.rows(self.world, prim), u)
        if name == "sphere":
            return uniform_sphere(u)
        flat = {"triangle": uniform_triangle, "disk": concentric_disk}.get(name)
        place = u if flat is None else flat(u)
        return torch.cat((place, torch.zeros_like(u[:1])))

    def brought(self, beam: Beam, x: Tensor) -> Tensor:
        """Return what lights bring to points ``x (3, N)`` float64, over the density of the draw: irradiance facing them."""
        lights, found = self.world.lights, torch.zeros(3, x.shape[1], dtype=torch.float64, device=x.device)
        assert lights is not None
        for k, name in enumerate(lights.kinds):
            mine = (self._of(k, beam.row) & (beam.row >= 0)).nonzero().squeeze(1)
            if not len(mine):
                continue
            part = rows(beam, mine)
            at = lane_rows(lights, part.row if len(lights.area) > 1 else None)
            if name in SURFACES:
                found[:, mine] = self._shone(name, lights, at, part, take(x, mine))
                continue
            drawn = KINDS[name].sample(at, take(x, mine).to(at.p0), part.u.to(at.p0), False)
            found[:, mine] = (drawn.radiance * drawn.weight).double() / part.chance
        return found

    def _shone(self, name: str, lights: Lights, at: Lights, beam: Beam, x: Tensor) -> Tensor:
        """Return the same of surfaces."""
        y, a = beam.view.e, beam.held.a
        normal = at.normal.double().expand_as(y)
        if name == "sphere":
            normal = a * at.flip.double()
        elif name == "quadric":
            assert at.quadrics is not None
            normal = quadrics.outward(at.quadrics, a.to(at.p0)).double()
        size = SURFACES[name].size(at, normal.to(at.p0))
        area = (at.area if size is None else size).double()
        wi = y - x
        square = dot(wi, wi)
        cosine = (-dot(wi, normal)).clamp_min(0.0) / square.sqrt()
        radiance = at.radiance if at.opacity is None else at.radiance * at.opacity
        point = None
        if lights.prim is not None:
            prim, place, own = beam.held.prim, a.to(at.p0), a.to(at.p0) if name == "quadric" else None
            n = normal.to(at.p0)
            point = Interaction(y.to(at.p0), n, n, None, None, prim, prim, None, place[0], place[1], own)
        flat = torch.zeros_like(wi, dtype=at.p0.dtype)
        sample = LightSample(flat, flat, None, radiance.expand_as(flat), flat[0], flat[0], point)
        return light_radiance(self.world, sample).double() * (cosine * area / (square * beam.chance))


def sources_of(bodies: Bodies, world: World, reach: float, met: bool) -> Sources | None:
    """Return the lights; None where there are none.

    Args:
        bodies: detached.
        world: the scene's tensors.
        reach: radius of the scene.
        met: whether only lights that rays meet by chance count, as with the strategy ``bsdf``.
    """
    lights = world.lights
    if lights is None:
        return None
    count = len(lights.area)
    prim = torch.zeros(count, dtype=torch.int64, device=lights.area.device)
    surfaces = 0
    if lights.row_of_prim is not None:
        mine = (lights.row_of_prim >= 0).nonzero().squeeze(1)
        prim[take(lights.row_of_prim, mine)] = mine
        surfaces = len(mine)
    bright = luminance(lights.radiance.double().abs()) + 1e-12 * lights.radiance.double().abs().amax(0)
    weight = bright * math.pi * lights.area.double()
    for k, name in enumerate(lights.kinds):
        mine = torch.ones_like(prim, dtype=torch.bool) if lights.kind is None else lights.kind == k
        if name in SURFACES:
            continue
        kind = KINDS[name]
        size = 4.0 * math.pi
        if kind.distant:
            size = math.pi * reach**2 * (4.0 * math.pi if issubclass(kind, Environment) else 1.0)
        factor = 0.0 if met and not issubclass(kind, Environment) else size
        weight = torch.where(mine, bright * factor, weight)
    if not bool((weight > 0).any()):
        return None
    return Sources(bodies, world, Distribution1D.of(weight, torch.float64, even=0.05), prim, surfaces)


# ---- Edges of shadows: curves on surfaces along which light from one point begins to pass an edge
#
# For a point y of a light, held on its surface, and a place p on an outline as y sees it, the ray from y past p meets a
# receiver at x: there, for this y, light begins. The curve of such x moves over the receiver as y, p and the receiver do,
# against the point that the interior has there (:mod:`torchpt.gradients.edges.receivers`). From x light is followed on toward
# the camera (boundary segments of Zhang, Miller, Yan, Gkioulekas, Zhao, *Path-Space Differentiable Rendering*, 2020).


#: Rays past an edge begin so many steps before it, but not nearer to a light than half the way, and a step beside it: the
#: rounding of its place.
_BEFORE = 2.0**14
#: What they meet within so many steps of the edge ends there.
_AT = 16.0
#: The same of the edge's own round surface, in roots of the surface's size times the step.
_ROUND = 16.0
#: What rays to lights meet so close before them, against the whole way, is the light.
_END = 2.0**-12
#: Random numbers of rays to lights are as of a vertex that no path has.
_TO_LIGHT = 1 << 11


@dataclass(frozen=True)
class Cast:
    """Samples of shadow edges; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        frame: of the interior.
        lights_move: True: lights may move.
        beam: where light comes from.
        source: ``(N,)`` column of ``Bodies.lights``, -1 for what is held on a surface, -2 for what does not move.
        edge: the places past which it goes.
        receiver: the points where it arrives.
        normal: of the receiver ``(3, N)``.
        prefixes: of the receivers, each with weights ``(3, M)`` of their motion over the receiver.
    """

    frame: MovingFrame
    lights_move: bool
    beam: Beam
    source: Tensor
    edge: Held
    receiver: Held
    normal: Tensor
    prefixes: list[tuple[Prefix, Tensor]]

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        cotangents, still = Cotangents(self.frame.moves), self.frame.bodies
        p, n, w = still.points(self.edge), self.normal, self.beam.view.w
        x = torch.zeros_like(p)
        for prefix, weight in self.prefixes:
            x.index_add_(1, prefix.lane, weight)
            prefix.pull_back(cotangents, -weight)
        # Light goes from e past p to the receiver's plane: to p - toward (n . (p - held)) / (n . toward).
        toward = self.beam.view.toward(p)
        steep = dot(n, toward)
        far = dot(n, p - still.points(self.receiver)) / steep
        on_plane = n * (dot(x, toward) / steep)
        rest = x - on_plane
        cotangents.add_points(self.receiver, on_plane)
        cotangents.add_points(self.edge, rest * (1.0 + far * w))
        self._pull_back_lights(cotangents, rest * -far)
        return cotangents.sum(bodies)

    def _pull_back_lights(self, cotangents: Cotangents, cotangent: Tensor) -> None:
        """Add what a cotangent ``(3, N)`` of where light comes from asks."""
        surface = (self.source == -1).nonzero().squeeze(1)
        cotangents.add_points(rows(self.beam.held, surface), take(cotangent, surface))
        own = (self.source >= 0).nonzero().squeeze(1)
        if len(own) and self.lights_move:
            far = torch.as_tensor(self.beam.view.w, device=own.device) == 0
            cotangent = torch.where(far, -cotangent, cotangent)  # distant lights are where they go
            cotangents.add_lights(take(self.source, own), take(cotangent, own))


@dataclass(frozen=True)
class Shadows:
    """The estimator of one render.

    Attributes:
        frame: of the interior.
        occluders: what throws shadows.
        sources: the lights.
        depth: vertices of paths at most; -1: any number.
        lights_move: True: lights may move.
    """

    frame: MovingFrame
    occluders: Occluders
    sources: Sources
    depth: int
    lights_move: bool

    @torch.no_grad()
    def samples(self, turn: Round, first: int, count: int) -> Cast | None:
        """Return samples ``first .. first + count`` of a round; None where none of them counts."""
        traced = self.frame.traced
        _, key, u, coin = traced.edges(turn, first, count, Use.LIGHTS)
        u, scale = turn.draw(torch.cat((u[None], self.sources.numbers(traced.draws(key)))))
        beam = self.sources.draw(u[1:])
        passed = self.occluders.points(self.occluders.outlines, u[0], coin, beam.view)
        passed = rows(passed, passed.outline.nonzero().squeeze(1))
        beam, passed, spot, outward = self._past(rows(beam, passed.lane), passed, take(key, passed.lane))
        if not len(passed.lane):
            return None
        cast = self._cast(take(key, passed.lane), beam, passed, spot, outward, take(scale, passed.lane))
        if turn.memory is not None and cast is not None:
            brought = torch.zeros_like(scale)
            for prefix, weight in cast.prefixes:
                brought.index_add_(0, take(passed.lane, prefix.lane), dot(weight, weight).sqrt())
            turn.record(u, scale, brought)
        return cast

    def _past(self, beam: Beam, passed: OutlinePoints, key: Tensor) -> tuple[Beam, OutlinePoints, Spot, Tensor]:
        """Trace rays past edges: return what they meet, and unit vectors ``(3, N)`` across the edge to the lit side.

        The rays begin close to the edge, so that what lies closely behind it is told from it however far the light is; another
        ray looks from there to the light.

        Before the edge the rays to both sides pass the same surfaces by their opacity. Behind it the lit one decides anew, by
        numbers of its own: those that stopped the other one at the edge are used up.
        """
        traced, bodies = self.frame.traced, self.frame.bodies
        toward = beam.view.toward(passed.p)
        w = torch.as_tensor(beam.view.w, device=toward.device).expand(toward.shape[1])
        length = dot(toward, toward).sqrt()
        away = -toward / length
        step = self.frame.rounding(passed.held.prim, passed.p)
        begin = torch.minimum(step * _BEFORE, torch.where(w > 0, 0.5 * length, torch.inf))
        aside = cross(passed.along, toward)
        aside = aside / dot(aside, aside).sqrt()
        n = len(passed.lane)
        o = passed.p - away * begin
        beside = torch.cat((o + aside * step, o - aside * step), 1)
        keys = torch.cat((key, key), 1)
        # Behind a body's front an edge may throw a shadow's border too: both rays have to come from the light.
        aim = torch.where(w > 0, beam.view.e - o, -away)
        far = torch.where(w > 0, 1.0 - _END, T_MAX).repeat(2)
        lit = ~traced.blocked(beside, torch.cat((aim, aim), 1), far, Passing(keys, depth=_TO_LIGHT)).view(2, n).any(0)
        t, prim = traced.nearest(beside, torch.cat((away, away), 1), Passing(keys, depth=1))
        t, prim = t.view(2, n), prim.view(2, n)
        own = (prim == passed.held.prim) | ((prim == passed.mate) & (passed.mate >= 0))
        # A ray beside an edge meets a flat face of it anywhere, as one beside an outline what it is the outline of; at a rim a
        # round surface comes forward by the root of the step.
        ends = own & (passed.bent | torch.stack([bodies.is_flat(x.clamp_min(0)) for x in prim]))
        size = torch.stack([dot(axis, axis) for axis in bodies.place(passed.held.prim)[1:]]).amax(0).sqrt()
        slack = step * _AT + torch.where(own, _ROUND * (size * step).sqrt(), 0.0)
        hidden = ~ends & (t < begin - slack)
        near = ends | (~hidden & (t < begin + slack))
        far = ~hidden & ~near
        good = lit & ((near[0] & far[1]) | (near[1] & far[0]))
        index = good.nonzero().squeeze(1)
        side = torch.where(take(far[0], index), 1.0, -1.0)
        outward = take(aside, index) * side
        o = take(o, index) + outward * take(step, index)
        free = take(begin, index) + torch.where(side > 0, take(slack[0], index), take(slack[1], index))
        spot = met(traced, o, take(away, index), Passing(take(key, index), depth=0, free=free))
        some = (spot.hit.prim >= 0).nonzero().squeeze(1)
        index = take(index, some)
        return rows(beam, index), rows(passed, index), spot.taken(some), take(outward, some)

    def _cast(
        self, key: Tensor, beam: Beam, passed: OutlinePoints, spot: Spot, outward: Tensor, scale: Tensor
    ) -> Cast | None:
        x, n = spot.p.double(), spot.n.double()
        toward = beam.view.toward(x)
        wi = toward / dot(toward, toward).sqrt()
        leaving = beam.view.toward(passed.p)
        slope = dot(n, leaving)
        stretch = 1.0 + dot(n, passed.p - x) / slope * beam.view.w

        def follow(v: Tensor) -> Tensor:
            return (v - leaving * (dot(n, v) / slope)) * stretch

        along, across = follow(passed.along), follow(outward)
        brought = self.sources.brought(beam, x) * (dot(n, wi).abs() * scale * passed.part / passed.density)
        edge = cross(n, along)
        edge = edge * -torch.sign(dot(edge, across))
        moves = self.frame.moving(passed.held.prim) | self.frame.moving(passed.mate)
        moves = None if self.lights_move else moves | self.frame.moving(spot.hit.prim)
        prefixes = []
        for prefix in prefixes_of(self.frame, spot, wi, key, self.depth, behind=1, moves=moves):
            value = (prefix.weight * take(brought, prefix.lane)).sum(0)
            prefixes.append((prefix, take(edge, prefix.lane) * value))
        if not prefixes:
            return None
        source, receiver = self._source(beam), spot.held(self.frame.bodies)
        return Cast(self.frame, self.lights_move, beam, source, passed.held, receiver, n, prefixes)

    def _source(self, beam: Beam) -> Tensor:
        """Return columns of ``Bodies.lights``; see :class:`Cast`."""
        column = beam.row - self.sources.surfaces
        around = self.sources.world.lights
        assert around is not None
        still = -1 if around.environment is None else len(around.area) - 1
        return torch.where(column < 0, -1, torch.where(beam.row == still, -2, column))
