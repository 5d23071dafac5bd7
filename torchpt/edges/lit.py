"""Points on lights, drawn for all edges alike: by power, and evenly over a light's surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.edges.bodies import Bodies, Held
from torchpt.edges.curves import View
from torchpt.edges.draws import Choice, Numbers
from torchpt.integrators.light_sampling import light_radiance
from torchpt.lights import KINDS, SURFACES
from torchpt.lights.base import Environment, taken
from torchpt.math.vectors import dot, luminance, take
from torchpt.math.warps import concentric_disk, uniform_sphere, uniform_triangle
from torchpt.records import Interaction, Lights, LightSample, World, rows
from torchpt.shapes import quadrics

__all__ = ["Beam", "Sources", "sources_of"]


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
    choice: Choice
    prim: Tensor
    surfaces: int

    def draw(self, numbers: Numbers, sample: Tensor) -> Beam:
        """Points on lights for samples ``(N,)`` int64."""
        lights = self.world.lights
        assert lights is not None
        row, rest, chance = self.choice.draw(numbers.of(sample, 10))
        u = torch.stack((rest, numbers.of(sample, 11)))
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
            at = taken(lights, take(row, mine) if len(lights.area) > 1 else None)
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
            at = taken(lights, part.row if len(lights.area) > 1 else None)
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
    return Sources(bodies, world, Choice(weight / weight.sum() + 0.05 / count * (weight > 0)), prim, surfaces)
