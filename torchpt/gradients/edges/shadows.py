"""Edges of shadows of lights: what throws them, where they fall, and their share of the gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchpt.gradients.edges.bodies import Bodies, Held
from torchpt.gradients.edges.curves import (
    Curves,
    Rounds,
    View,
    folds_of,
    generator,
    joined,
    parts_of,
    plain_of,
    round_outline,
    rounds_of,
    straight,
)
from torchpt.gradients.edges.receivers import LONGEST, Frame, Prefix, held_at, prefixes_of
from torchpt.gradients.edges.traced import Use
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.sampling import Distribution1D, concentric_disk, uniform_sphere, uniform_triangle
from torchpt.math.vectors import cross, dot, luminance, rows, take
from torchpt.paths.vertex import light_radiance
from torchpt.physics.lights import KINDS, SURFACES, from_digits
from torchpt.physics.lights.base import Environment, lane_rows
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.physics.samplers import Dimension, Draws
from torchpt.physics.shapes import quadrics
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.shapes.quadrics import Form
from torchpt.physics.world import World
from torchpt.scene import Scene

__all__ = ["STILL", "Beam", "Cast", "Occluders", "Passed", "Shadows", "Sources", "occluders_of", "sources_of"]


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

    def draw(self, draws: Draws) -> Beam:
        """Draw points on lights."""
        lights = self.world.lights
        assert lights is not None
        u = draws.two(Dimension.LIGHT)
        row, rest = self.choice.draw(from_digits(torch.stack((u[0], draws.one(Dimension.LIGHT_DIGITS)))))
        chance, u = take(self.choice.pmf, row), torch.stack((rest, u[1].double()))
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
        """Numbers ``(3, n)`` of places even by area, in a quadric's own space."""
        if name == "quadric":
            assert self.world.geometry.quadrics is not None
            return quadrics.sample(quadrics.rows(self.world, prim), u)
        if name == "sphere":
            return uniform_sphere(u)
        flat = {"triangle": uniform_triangle, "disk": concentric_disk}.get(name)
        place = u if flat is None else flat(u)
        return torch.cat((place, torch.zeros_like(u[:1])))

    def brought(self, beam: Beam, x: Tensor) -> Tensor:
        """What lights bring to points ``x (3, N)`` float64, over the density of the draw: irradiance on what faces them."""
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
        """The same of surfaces."""
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
    """The lights; None where there are none.

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


# ---- The curves of a scene that may throw shadows, to be drawn from before it is known where the light comes from


#: Least weight of an edge between faces that almost lie in one plane, against a border of the same length.
_LEAST = 0.01


@dataclass(frozen=True)
class Passed:
    """Places of curves that light passes, N lanes.

    Attributes:
        lane: ``(N,)`` of those that were asked for: where there is no outline there is no place.
        held: the places.
        mate: the other face at each, -1 where there is none.
        p: where they are ``(3, N)``.
        along: how ``p`` changes with the curve's parameter.
        density: of the draw in that parameter, over the part with which the curve counts.
    """

    lane: Tensor
    held: Held
    mate: Tensor
    p: Tensor
    along: Tensor
    density: Tensor


@dataclass(frozen=True)
class Occluders:
    """K curves and round surfaces.

    Attributes:
        bodies: detached.
        curves: what is not known before the light is (an outline) has its primitive alone.
        others: corners off the edges, of both faces.
        folded: ``(K,)`` bool: edges of two faces, which throw a shadow only where both lie to one side of it.
        part: ``(K,)`` with which curves count where others lie on them.
        form: ``(K,)`` -1 where the curve is known, 0 for outlines of spheres, from 1 on of ``forms``.
        forms: of cylinders and cones.
        choice: among them.
    """

    bodies: Bodies
    curves: Curves
    others: tuple[Held, Held]
    folded: Tensor
    part: Tensor
    form: Tensor
    forms: list[Form]
    choice: Distribution1D

    def draw(self, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return curves ``(N,)``, what is left of ``u``, and their chances."""
        index, rest = self.choice.draw(u)
        return index, rest, take(self.choice.pmf, index)

    def place(self, index: Tensor, rest: Tensor, chance: Tensor, coin: Tensor, view: View) -> Passed:
        """Places on drawn curves as they are seen from ``view``.

        Args:
            index: curves ``(N,)``.
            rest: in [0, 1), where on them.
            chance: of the curves.
            coin: in [0, 1): which of two lines.
            view: ``N`` places or directions.
        """
        curves, form = rows(self.curves, index), take(self.form, index)
        some, chance = torch.ones_like(form, dtype=torch.bool), chance.clone()
        for number in range(len(self.forms) + 1):
            mine = (form == number).nonzero().squeeze(1)
            if not len(mine):
                continue
            part, prim = rows(view, mine), take(curves.prim, mine)
            if number == 0:
                found, there = round_outline(self.bodies, prim, part)
            else:
                side = torch.where(take(coin, mine) < 0.5, -1.0, 1.0).double()
                found, there = generator(self.bodies, prim, self.forms[number - 1], part, side)
                chance[mine] *= 0.5
            some[mine] = there
            for f in fields(Curves):
                getattr(curves, f.name)[..., mine] = getattr(found, f.name)
        span = curves.high - curves.low
        held, p, along = curves.moving(self.bodies, curves.low + rest * span)
        across = cross(along, view.toward(p))
        one, two = (dot(across, self.bodies.points(rows(other, index)) - p) for other in self.others)
        some &= ~take(self.folded, index) | (one * two >= 0)
        some &= dot(across, across) > 0
        passed = Passed(
            torch.arange(len(index), device=index.device),
            held,
            curves.mate,
            p,
            along,
            chance / (span * take(self.part, index)),
        )
        return rows(passed, some.nonzero().squeeze(1))


#: Weight of edges that do not move: only what is behind and before them does.
STILL = 0.3


def occluders_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor], moves: Tensor) -> Occluders | None:
    """Return all curves, by their length and the chance to be an outline; None where there are none.

    Args:
        scene: the scene.
        bodies: detached.
        poses: the parameters.
        moves: ``(P,)`` bool: primitives that move, or all where lights do.
    """
    curves, firsts, seconds, folded, weights, forms = [], [], [], [], [], []
    for folds in folds_of(scene, bodies, poses):
        _, _, along = folds.curves.moving(bodies, torch.zeros_like(folds.curves.low))
        cosine = dot(*folds.normals).abs().clamp_max(1.0)
        # Of directions around an edge this share has both faces on one side, whichever way the normals point.
        share = torch.where(folds.border, 1.0, (torch.acos(cosine) / math.pi).clamp_min(_LEAST))
        curves.append(folds.curves)
        firsts.append(folds.others[0])
        seconds.append(folds.others[1])
        folded.append(~folds.border)
        weights.append(dot(along, along).sqrt() * share)
        forms.append(torch.full_like(folds.curves.prim, -1))
    fixed = plain_of(scene, bodies)
    if fixed is not None:
        _, _, along = fixed.moving(bodies, fixed.low)
        curves.append(fixed)
        weights.append(dot(along, along).sqrt() * (fixed.high - fixed.low))
        forms.append(torch.full_like(fixed.prim, -1))
    kinds: list[Form] = []
    for rounds in rounds_of(scene, bodies):
        weight, number = _round_weight(bodies, rounds), 0
        if rounds.form is not None:
            kinds.append(rounds.form)
            number = len(kinds)
        zero = torch.zeros(3, len(rounds.prim), dtype=torch.float64, device=scene.device)
        curves.append(straight(rounds.prim, zero, zero))
        weights.append(weight)
        forms.append(torch.full_like(rounds.prim, number))
    for k, part in enumerate(curves):
        if k >= len(firsts):
            held = Held(part.prim, part.a)
            firsts.append(held)
            seconds.append(held)
            folded.append(torch.zeros_like(part.prim, dtype=torch.bool))
    if not curves or not bool((torch.cat(weights) > 0).any()):
        return None
    others = [Held(torch.cat([h.prim for h in x]), torch.cat([h.a for h in x], 1)) for x in (firsts, seconds)]
    every = joined(curves)
    moving = take(moves, every.prim) | ((every.mate >= 0) & take(moves, every.mate.clamp_min(0)))
    choice = Distribution1D.of(torch.cat(weights) * torch.where(moving, 1.0, STILL), torch.float64, even=0.0)
    form = torch.cat(forms)
    drawn = ((form < 0) & (torch.cat(weights) > 0)).nonzero().squeeze(1)
    part = torch.ones_like(every.low).index_copy(0, drawn, parts_of(bodies, rows(every, drawn)))
    return Occluders(bodies, every, (others[0], others[1]), torch.cat(folded), part, form, kinds, choice)


def _round_weight(bodies: Bodies, rounds: Rounds) -> Tensor:
    """About the lengths of outlines ``(N,)``."""
    _, x, y, z = bodies.place(rounds.prim)
    long = [dot(axis, axis).sqrt() for axis in (x, y, z)]
    return 2.0 * long[2] if rounds.form is not None else (2.0 * math.pi / 3.0) * (long[0] + long[1] + long[2])


# ---- Edges of shadows: curves on surfaces along which light from one point begins to pass an edge
#
# For a point y of a light, held on its surface, and a place p on an outline as y sees it, the ray from y past p meets a
# receiver at x: there, for this y, light begins. The curve of such x moves over the receiver as y, p and the receiver do,
# against the point that the interior has there (:mod:`torchpt.gradients.edges.receivers`). From x light is followed on toward
# the camera (boundary segments of Zhang, Miller, Yan, Gkioulekas, Zhao, *Path-Space Differentiable Rendering*, 2020).


#: Rays past an edge go so far beside it, against the way to it.
_STEP = 2.0**-16
#: What ends so close to an edge, against the way to it, ends at it.
_NEAR = 2.0**-10
#: The same where it ends at the edge's own surface, which may come forward quickly.
_OWN = 2.0**-6
#: Where a ray from a light begins, against the way to the edge.
_BEGIN = 2.0**-12


@dataclass(frozen=True)
class Cast:
    """Samples of shadow edges; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        beam: where light comes from.
        source: ``(N,)`` column of ``Bodies.lights``, -1 for what is held on a surface, -2 for what does not move.
        edge: the places past which it goes.
        receiver: the points where it arrives.
        normal: of the receiver ``(3, N)``.
        seen: prefixes of the receivers, each with weights ``(3, M)`` of their motion over the receiver.
    """

    beam: Beam
    source: Tensor
    edge: Held
    receiver: Held
    normal: Tensor
    seen: list[tuple[Prefix, Tensor]]

    def sum(self, bodies: Bodies) -> Tensor:
        """Return a number, differentiable in ``bodies``; of no meaning but for its derivative."""
        e, w = self._from(bodies), self.beam.view.w
        p, held = bodies.points(self.edge), bodies.points(self.receiver)
        toward = e - p * w
        x = p - toward * (dot(self.normal, p - held) / dot(self.normal, toward))
        value = torch.zeros((), dtype=x.dtype, device=x.device)
        for prefix, weight in self.seen:
            value = value + ((take(x, prefix.lane) - prefix.receivers(bodies)) * weight).sum()
        return value

    def _from(self, bodies: Bodies) -> Tensor:
        e = torch.where(self.source == -1, bodies.points(self.beam.held), self.beam.view.e)
        if not bodies.lights.shape[1]:
            return e
        own = take(bodies.lights, self.source.clamp_min(0))
        far = torch.as_tensor(self.beam.view.w, device=e.device) == 0
        return torch.where(self.source >= 0, torch.where(far, -own, own), e)


@dataclass(frozen=True)
class Shadows:
    """The estimator of one render.

    Attributes:
        frame: of the interior.
        occluders: what throws shadows.
        sources: the lights.
        reach: radius of the scene.
        depth: vertices of paths at most; -1: any number.
    """

    frame: Frame
    occluders: Occluders
    sources: Sources
    reach: float
    depth: int

    @torch.no_grad()
    def samples(self, first: int, count: int, total: int) -> Cast | None:
        """Return samples ``first .. first + count`` of ``total``; None where none of them counts."""
        traced, bodies = self.frame.traced, self.frame.bodies
        number = torch.arange(first, first + count, device=bodies.p0.device)
        key = traced.key(number, Use.LIGHTS)
        u, coin = traced.edge(number, key, total)
        index, rest, chance = self.occluders.draw(u)
        beam = self.sources.draw(traced.draws(key))
        passed = self.occluders.place(index, rest, chance, coin, beam.view)
        beam, passed, spot, outward = self._past(rows(beam, passed.lane), passed)
        if not len(passed.lane):
            return None
        return self._cast(take(key, passed.lane), beam, passed, spot, outward, total)

    def _past(self, beam: Beam, passed: Passed) -> tuple[Beam, Passed, Spot, Tensor]:
        """Rays past edges: what they meet, and unit vectors ``(3, N)`` across the edge to the side that is lit."""
        traced = self.frame.traced
        toward = beam.view.toward(passed.p)
        w = torch.as_tensor(beam.view.w, device=toward.device).expand(toward.shape[1])
        length = dot(toward, toward).sqrt()
        o = torch.where(w > 0, passed.p + toward * (1.0 - _BEGIN), passed.p + toward * (4.0 * self.reach / length))
        way = passed.p - o
        aside = cross(passed.along, toward)
        aside = aside / dot(aside, aside).sqrt()
        step = aside * (dot(way, way).sqrt() * _STEP)
        n = len(passed.lane)
        t, prim = traced.nearest(torch.cat((o, o), 1), torch.cat((way + step, way - step), 1))
        t, prim = t.view(2, n), prim.view(2, n)
        own = (prim == passed.held.prim) | ((prim == passed.mate) & (passed.mate >= 0))
        hidden = t < torch.where(own, 1.0 - _OWN, 1.0 - _NEAR)
        near = (t < 1.0 + _NEAR) & ~hidden
        far = (t > 1.0 + _NEAR) & (prim >= 0)
        good = (near[0] & far[1]) | (near[1] & far[0])
        index = good.nonzero().squeeze(1)
        side = torch.where(take(far[0], index), 1.0, -1.0)
        outward = take(aside, index) * side
        spot = met(traced, take(o, index), take(way, index) + take(step, index) * side)
        some = (spot.hit.prim >= 0).nonzero().squeeze(1)
        index = take(index, some)
        return rows(beam, index), rows(passed, index), spot.taken(some), take(outward, some)

    def _cast(self, key: Tensor, beam: Beam, passed: Passed, spot: Spot, outward: Tensor, total: int) -> Cast | None:
        x, n = spot.p.double(), spot.n.double()
        toward = beam.view.toward(x)
        wi = toward / dot(toward, toward).sqrt()
        leaving = beam.view.toward(passed.p)
        slope = dot(n, leaving)
        stretch = 1.0 + dot(n, passed.p - x) / slope * beam.view.w

        def follow(v: Tensor) -> Tensor:
            return (v - leaving * (dot(n, v) / slope)) * stretch

        along, across = follow(passed.along), follow(outward)
        brought = self.sources.brought(beam, x) * (dot(n, wi).abs() / (passed.density * total))
        edge = cross(n, along)
        edge = edge * -torch.sign(dot(edge, across))
        longest = (self.depth if self.depth >= 0 else LONGEST) - 1
        seen = []
        for prefix in prefixes_of(self.frame, spot, wi, key, longest):
            value = (prefix.weight * take(brought, prefix.lane)).sum(0)
            seen.append((prefix, take(edge, prefix.lane) * value))
        if not seen:
            return None
        receiver = held_at(self.frame.bodies, spot.hit.prim, torch.stack((spot.hit.u, spot.hit.v)), x)
        return Cast(beam, self._source(beam), passed.held, receiver, n, seen)

    def _source(self, beam: Beam) -> Tensor:
        """Columns of ``Bodies.lights``; see :class:`Cast`."""
        column = beam.row - self.sources.surfaces
        around = self.sources.world.lights
        assert around is not None
        still = -1 if around.environment is None else len(around.area) - 1
        return torch.where(column < 0, -1, torch.where(beam.row == still, -2, column))
