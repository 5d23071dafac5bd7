"""Edges of shadows and of what is seen by way of further surfaces: occluders, lit points, and their share of the gradient."""

from __future__ import annotations

import math
from collections.abc import Callable
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
    plain_of,
    round_outline,
    rounds_of,
    straight,
)
from torchpt.gradients.edges.film import Worth, film_places, slopes
from torchpt.gradients.edges.traced import Traced, Use
from torchpt.gradients.edges.vertices import Spot, met
from torchpt.math.sampling import Distribution1D, concentric_disk, uniform_sphere, uniform_triangle
from torchpt.math.vectors import cross, dot, largest, luminance, rows, take
from torchpt.paths.roulette import russian_roulette, survival_probability
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

__all__ = ["Beam", "Cast", "Occluders", "Passed", "Shadows", "Sources", "occluders_of", "sources_of"]


# ---- Points on lights, drawn for all edges alike: by power, and evenly over a light's surface


@dataclass(frozen=True)
class Beam:
    """Light that may pass edges, N lanes.

    Attributes:
        view: from where it comes.
        held: the point that it leaves; where ``row`` says that it is on a surface.
        row: ``(N,)`` of the table of lights; -1: light that a surface reflects.
        u: ``(2, N)`` of the direction, of environments.
        chance: ``(N,)`` density of the row and, on surfaces, of the place by area; of reflected light of the direction.
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
        density: of the draw in that parameter.
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
        form: ``(K,)`` -1 where the curve is known, 0 for outlines of spheres, from 1 on of ``forms``.
        forms: of cylinders and cones.
        choice: among them.
    """

    bodies: Bodies
    curves: Curves
    others: tuple[Held, Held]
    folded: Tensor
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
        passed = Passed(torch.arange(len(index), device=index.device), held, curves.mate, p, along, chance / span)
        return rows(passed, some.nonzero().squeeze(1))


def occluders_of(scene: Scene, bodies: Bodies, poses: dict[str, Tensor]) -> Occluders | None:
    """All curves, by their length and the chance to be an outline; None where there are none."""
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
    choice = Distribution1D.of(torch.cat(weights), torch.float64, even=0.0)
    return Occluders(bodies, joined(curves), (others[0], others[1]), torch.cat(folded), torch.cat(forms), kinds, choice)


def _round_weight(bodies: Bodies, rounds: Rounds) -> Tensor:
    """About the lengths of outlines ``(N,)``."""
    _, x, y, z = bodies.place(rounds.prim)
    long = [dot(axis, axis).sqrt() for axis in (x, y, z)]
    return 2.0 * long[2] if rounds.form is not None else (2.0 * math.pi / 3.0) * (long[0] + long[1] + long[2])


# ---- Edges of shadows: curves on surfaces along which light from one point begins to pass an edge
#
# For a point y that light comes from, held on its surface, and a place p on an outline as y sees it, the ray from y past p
# meets a receiver at x: there, for this y, light begins. Seen by the camera the curve lies on the film, ``s = camera(x)``, and
# moves as y, p, the receiver and the camera do: see :mod:`torchpt.gradients.edges.primary`. Seen by way of further surfaces it
# lies on the receiver, ``x`` against the point that is held there (the material form of Zhang, Miller, Yan, Gkioulekas, Zhao,
# *Path-Space Differentiable Rendering*, 2020, whose boundary segments these are): from x light is followed on toward the
# camera.


#: Rays past an edge go so far beside it, against the way to it.
_STEP = 2.0**-16
#: What ends so close to an edge, against the way to it, ends at it.
_NEAR = 2.0**-10
#: The same where it ends at the edge's own surface, which may come forward quickly.
_OWN = 2.0**-6
#: Where a ray from a light begins, against the way to the edge.
_BEGIN = 2.0**-12
#: Vertices after which light that reaches no camera is given up where paths have no limit of their own.
_MOST = 32
#: From this vertex on roulette plays.
_ROULETTE = 3

#: Light ``(3, n)`` that arrives in lanes ``(n,)``, for paths of ``k`` vertices from there to the camera.
Brought = Callable[[int, Tensor], Tensor]


@dataclass(frozen=True)
class Cast:
    """Samples of shadow edges; the derivative of the loss is that of :meth:`sum`.

    Attributes:
        beam: where light comes from.
        source: ``(N,)`` column of ``Bodies.lights``, -1 for what is held on a surface, -2 for what does not move.
        edge: the places past which it goes.
        receiver: the points where it arrives.
        normal: of the receiver ``(3, N)``.
        film: weights ``(2, N)`` of places on the film.
        surface: weights ``(3, N)`` of places against the receiver's own points; None where nobody asks.
    """

    beam: Beam
    source: Tensor
    edge: Held
    receiver: Held
    normal: Tensor
    film: Tensor
    surface: Tensor | None

    def sum(self, bodies: Bodies) -> Tensor:
        """Differentiable in ``bodies``; of no meaning but for its derivative."""
        e, w = self._from(bodies), self.beam.view.w
        p, held = bodies.points(self.edge), bodies.points(self.receiver)
        toward = e - p * w
        x = p - toward * (dot(self.normal, p - held) / dot(self.normal, toward))
        value = (film_places(bodies.camera, x) * self.film).sum()
        return value if self.surface is None else value + ((x - held) * self.surface).sum()

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
        bodies: detached.
        occluders: what throws shadows.
        sources: the lights; None: what surfaces reflect.
        traced: what sees, and draws.
        reach: radius of the scene.
        depth: vertices of paths at most; -1: any number.
        onward: whether light that reaches the camera by way of further surfaces counts too.
    """

    bodies: Bodies
    occluders: Occluders
    sources: Sources | None
    traced: Traced
    reach: float
    depth: int
    onward: bool

    @torch.no_grad()
    def samples(self, first: int, count: int, total: int, worth: Worth) -> Cast | None:
        """Samples ``first .. first + count`` of ``total``; None where none of them counts."""
        number = torch.arange(first, first + count, device=self.bodies.p0.device)
        key = self.traced.key(number, Use.REFLECTED if self.sources is None else Use.LIGHTS)
        u, coin = self.traced.edge(number, key, total)
        index, rest, chance = self.occluders.draw(u)
        if self.sources is not None:
            beam = self.sources.draw(self.traced.draws(key))
            passed = self.occluders.place(index, rest, chance, coin, beam.view)
            beam = rows(beam, passed.lane)
        else:
            beam, passed = self._reflected(key, index, rest, chance, coin)
        beam, passed, spot, outward = self._past(beam, passed)
        if not len(passed.lane):
            return None
        return self._cast(take(number, passed.lane), take(key, passed.lane), beam, passed, spot, outward, worth, total)

    def _reflected(self, key: Tensor, index: Tensor, rest: Tensor, chance: Tensor, coin: Tensor) -> tuple[Beam, Passed]:
        """Points of surfaces, by a direction from the edge; of edges that are the same from everywhere."""
        away = uniform_sphere(self.traced.draws(key).two(Dimension.BSDF).double())
        known = (take(self.occluders.form, index) < 0).nonzero().squeeze(1)
        index, rest, chance, coin, away = (take(x, known) for x in (index, rest, chance, coin, away))
        passed = self.occluders.place(index, rest, chance, coin, View(away, 0.0))
        away = take(away, passed.lane)
        aside = cross(passed.along, away)
        aside = aside / dot(aside, aside).sqrt() * (_STEP * self.reach)
        spots = [met(self.traced, passed.p + aside * side, away) for side in (1.0, -1.0)]
        far = [torch.where(spot.hit.prim >= 0, spot.hit.t, -1.0) for spot in spots]
        first = far[0] >= far[1]
        prim = torch.where(first, spots[0].hit.prim, spots[1].hit.prim)
        y = torch.where(first, spots[0].p, spots[1].p).double()
        numbers = [torch.where(first, getattr(spots[0].hit, k), getattr(spots[1].hit, k)) for k in ("u", "v")]
        # A ray through a straight edge meets none of the edge's own flat faces again: where rounding says so, a step beside the
        # edge, the point does not lie in the direction that its density is for, and its light has no bound.
        own = (prim == passed.held.prim) | (prim == passed.mate)
        flat = (prim < self.bodies.first_sphere) | (prim >= sum(self.bodies.counts))  # instances are of triangles
        some = ((prim >= 0) & ~(own & flat)).nonzero().squeeze(1)
        prim, y = take(prim, some), take(y, some)
        held = self._held(prim, take(torch.stack(numbers), some), y)
        passed = rows(passed, some)
        row = torch.full_like(prim, -1)
        one = torch.ones_like(y[0])
        beam = Beam(View(y, one), held, row, torch.zeros_like(y[:2]), one / (4.0 * math.pi))
        lane = take(known, passed.lane)
        return beam, Passed(lane, passed.held, passed.mate, passed.p, passed.along, passed.density)

    def _past(self, beam: Beam, passed: Passed) -> tuple[Beam, Passed, Spot, Tensor]:
        """Rays past edges: what they meet, and unit vectors ``(3, N)`` across the edge to the side that is lit."""
        toward = beam.view.toward(passed.p)
        w = torch.as_tensor(beam.view.w, device=toward.device).expand(toward.shape[1])
        length = dot(toward, toward).sqrt()
        o = torch.where(w > 0, passed.p + toward * (1.0 - _BEGIN), passed.p + toward * (4.0 * self.reach / length))
        way = passed.p - o
        aside = cross(passed.along, toward)
        aside = aside / dot(aside, aside).sqrt()
        step = aside * (dot(way, way).sqrt() * _STEP)
        n = len(passed.lane)
        t, prim = self.traced.nearest(torch.cat((o, o), 1), torch.cat((way + step, way - step), 1))
        t, prim = t.view(2, n), prim.view(2, n)
        own = (prim == passed.held.prim) | ((prim == passed.mate) & (passed.mate >= 0))
        hidden = t < torch.where(own, 1.0 - _OWN, 1.0 - _NEAR)
        near = (t < 1.0 + _NEAR) & ~hidden
        far = (t > 1.0 + _NEAR) & (prim >= 0)
        good = (near[0] & far[1]) | (near[1] & far[0])
        index = good.nonzero().squeeze(1)
        side = torch.where(take(far[0], index), 1.0, -1.0)
        outward = take(aside, index) * side
        spot = met(self.traced, take(o, index), take(way, index) + take(step, index) * side)
        some = (spot.hit.prim >= 0).nonzero().squeeze(1)
        index = take(index, some)
        return rows(beam, index), rows(passed, index), spot.taken(some), take(outward, some)

    def _cast(
        self,
        number: Tensor,
        key: Tensor,
        beam: Beam,
        passed: Passed,
        spot: Spot,
        outward: Tensor,
        worth: Worth,
        total: int,
    ) -> Cast:
        x, n = spot.p.double(), spot.n.double()
        toward = beam.view.toward(x)
        wi = toward / dot(toward, toward).sqrt()
        leaving = beam.view.toward(passed.p)
        slope = dot(n, leaving)
        stretch = 1.0 + dot(n, passed.p - x) / slope * beam.view.w

        def follow(v: Tensor) -> Tensor:
            return (v - leaving * (dot(n, v) / slope)) * stretch

        along, across = follow(passed.along), follow(outward)
        light = dot(n, wi).abs() / (passed.density * total)
        if self.sources is not None:
            brought = self._shone(self.sources.brought(beam, x) * light)
        else:
            brought = self._bounced(number, beam, passed, x, wi, light)
        direct = self._seen(spot, wi, brought, worth)
        _, jacobian = slopes(self.bodies.camera, x)
        ds = (jacobian * along).sum(1)
        normal = torch.stack((ds[1], -ds[0]))
        sign = torch.sign((normal * (jacobian * across).sum(1)).sum(0))
        film = torch.where(direct != 0, -normal * (sign * direct), 0.0)
        surface = None
        if self.onward:
            edge = cross(n, along)
            sign = torch.sign(dot(edge, across))
            surface = -edge * (sign * self._followed(key, spot, wi, brought, worth))
        receiver = self._held(spot.hit.prim, torch.stack((spot.hit.u, spot.hit.v)), x)
        return Cast(beam, self._source(beam), passed.held, receiver, n, film, surface)

    def _source(self, beam: Beam) -> Tensor:
        """Columns of ``Bodies.lights``; see :class:`Cast`."""
        if self.sources is None:
            return beam.row
        column = beam.row - self.sources.surfaces
        around = self.sources.world.lights
        assert around is not None
        still = -1 if around.environment is None else len(around.area) - 1
        return torch.where(column < 0, -1, torch.where(beam.row == still, -2, column))

    @staticmethod
    def _shone(light: Tensor) -> Brought:
        """Of lights, the same for all paths."""
        return lambda _, lane: take(light, lane)

    def _bounced(self, number: Tensor, beam: Beam, passed: Passed, x: Tensor, wi: Tensor, light: Tensor) -> Brought:
        """What surfaces reflect from y to x; paths of more vertices on the way to the camera have fewer before."""
        to = beam.view.e - passed.p
        whole = beam.view.e - x
        factor = light * dot(to, to) / (dot(whole, whole) * beam.chance)
        o, most = x + whole * _BEGIN, self.traced.wave.integrator.limits.max_depth

        def brought(k: int, lane: Tensor) -> Tensor:
            rays = (take(o, lane), take(wi, lane), take(number, lane), Use.BEHIND)
            depth = most if most < 0 else most - k
            if not len(lane) or 0 <= depth < 2:  # nothing but light of sources themselves
                return torch.zeros_like(rays[1])
            return (self.traced.radiance(*rays, depth) - self.traced.radiance(*rays, 1)) * take(factor, lane)

        return brought

    def _camera(self, spot: Spot) -> tuple[Tensor, Tensor, Tensor]:
        """Which points the camera sees ``(n,)``, their places on the film, and directions to the camera."""
        camera, x = self.bodies.camera, spot.p.double()
        seen = camera.film_of(x)
        assert seen is not None
        s = film_places(camera, x)
        width, height = camera.resolution
        margin = 16.0  # pixels, for wide filters
        good = (seen[2] > 0) & (seen[3] > 0) & (s > -margin).all(0) & (s[0] < width + margin) & (s[1] < height + margin)
        index = good.nonzero().squeeze(1)
        s, x = take(s, index), take(x, index)
        o, d = camera.rays(s[0], s[1], None)
        o = o.expand_as(d)
        away = x - o
        t, prim = self.traced.nearest(o, d)
        reach = dot(away, d)
        off = (t - reach).abs() / reach
        visible = ((prim == take(spot.hit.prim, index)) & (off < _NEAR)) | (off < 2.0**-14)
        some = visible.nonzero().squeeze(1)
        return take(index, some), take(s, some), -take(d, some)

    def _seen(self, spot: Spot, wi: Tensor, brought: Brought, worth: Worth) -> Tensor:
        """What light that arrives from ``wi`` is worth where the camera sees it ``(N,)``, by area of the film."""
        found = torch.zeros_like(wi[0])
        index, s, wo = self._camera(spot)
        if len(index):
            sent = spot.taken(index).sent(wo.to(spot.p), take(wi, index).to(spot.p)).double()
            found[index] = (worth.at(s) * sent * brought(1, index)).sum(0)
        return found

    def _followed(self, key: Tensor, spot: Spot, wi: Tensor, brought: Brought, worth: Worth) -> Tensor:
        """What it is worth by way of further surfaces ``(N,)``, by area of the receiver."""
        found = torch.zeros_like(wi[0])
        lane = torch.arange(len(found), device=found.device)
        carried = torch.ones_like(wi)
        limit = self.depth if self.depth >= 0 else _MOST
        first = 1 if self.sources is not None else 2
        for k in range(2, limit - first + 1):
            o, d, weight = spot.scattered(wi.to(spot.p), take(key, lane), k)
            carried = carried * weight.double()
            alive = largest(carried) > 0
            if k > _ROULETTE:
                draws = self.traced.draws(take(key, lane), k)
                alive, carried = russian_roulette(
                    survival_probability(None, 1.0, largest(carried), None), draws, alive, carried
                )
            on = alive.nonzero().squeeze(1)
            lane, carried = take(lane, on), take(carried, on)
            spot = met(self.traced, take(o, on), take(d, on))
            some = (spot.hit.prim >= 0).nonzero().squeeze(1)
            lane, carried, spot = take(lane, some), take(carried, some), spot.taken(some)
            if not len(lane):
                break
            wi = -spot.d.double()
            index, s, wo = self._camera(spot)
            if not len(index):
                continue
            part = spot.taken(index)
            sent = part.sent(wo.to(spot.p), take(wi, index).to(spot.p)).double()
            _, jacobian = slopes(self.bodies.camera, part.p.double())
            grown = dot(cross(jacobian[0], jacobian[1]), part.n.double()).abs()
            back = take(lane, index)
            value = (worth.at(s) * sent * take(carried, index) * brought(k, back)).sum(0) * grown
            found.index_add_(0, back, value)
        return found

    def _held(self, prim: Tensor, uv: Tensor, x: Tensor) -> Held:
        """Points of surfaces, held there."""
        a = torch.cat((uv.double(), torch.zeros_like(x[:1])))
        bodies = self.bodies
        if bodies.counts[3] or bodies.counts[4]:
            bent = ((prim >= bodies.first_sphere) & (prim < sum(bodies.counts))).nonzero().squeeze(1)
            p0, *axes = bodies.place(take(prim, bent))
            faces = [cross(axes[1], axes[2]), cross(axes[2], axes[0]), cross(axes[0], axes[1])]
            away, det = take(x, bent) - p0, dot(axes[0], faces[0])
            a[:, bent] = torch.stack([dot(face, away) / det for face in faces])
        return Held(prim, a)
