"""The stages of the wavefront: pure functions of whole-wave tensors and an index of the lanes concerned.

Python ``if`` here asks only what the scene or the settings hold (:class:`Plan` is static), so a stage leaves out what is
not needed, and compiles to one graph whatever the number of lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt import lights
from torchpt.cameras import Camera
from torchpt.film import Filter
from torchpt.integrators.roulette import survived
from torchpt.integrators.surfaces import Surface, emission_map, opacity_map, surface_at
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import dot, largest, take
from torchpt.math.warps import uniform_hemisphere, uniform_sphere
from torchpt.records import BsdfSample, Hit, Interaction, LightSample, PathState, Shadow, World, rows
from torchpt.samplers import Dimension, Draws, Points
from torchpt.shapes import interact, offset_origin, reattach
from torchpt.shapes.interaction import OFFSET

__all__ = [
    "STRATEGIES",
    "Plan",
    "bounce",
    "emit",
    "escape",
    "generate",
    "scatter",
    "shade",
]

#: mis: light and BSDF sampling combined; bsdf, light: one of them; uniform: directions uniform over the hemisphere.
STRATEGIES = ("mis", "bsdf", "light", "uniform")

#: Shadow rays end this fraction of their length short of the light, beside the offset off its surface.
SHORTEN = 1e-4


@dataclass(frozen=True)
class Plan:
    """What a render asks of the stages; static."""

    sampler: Points
    strategy: str
    rr_prob: float | None
    dtype: torch.dtype
    tape: bool  # whether derivatives are wanted
    attached: bool  # whether they are wanted with respect to geometry


def generate(plan: Plan, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
    """Camera rays through pixels ``x, y (N,)``, at places drawn from the filter (and on the lens, where there is one)."""
    draws = Draws(plan.sampler, key, salts)
    place = filter.offset(draws.two(Dimension.PIXEL)).to(plan.dtype)
    lens = draws.two(Dimension.LENS).to(plan.dtype) if camera.lens else None
    o, d = camera.rays(x + 0.5 + place[0], y + 0.5 + place[1], lens)
    n = d.shape[1]
    ones = torch.ones_like(d)
    everywhere = torch.full((n,), math.inf, dtype=plan.dtype, device=d.device)
    lane = torch.arange(n, device=d.device)
    # No two tensors of a state share memory: a compiled stage would take that for a fact.
    return PathState(o.expand(3, n).clone(), d, everywhere, ones, torch.zeros_like(d), everywhere.clone(), lane, key)


def emit(world: World, state: PathState, hit: Hit, index: Tensor, slide: bool) -> Tensor:
    """Radiance ``(3, n)`` that the paths at ``index`` gather from the emitters they hit, weighted by MIS."""
    assert world.lights is not None
    o, d = take(state.o, index), take(state.d, index)
    at = interact(world, o, d, rows(hit, index), slide)
    # Where lights are chosen by place the density is that at the vertex itself, which is not quite where the ray begins.
    x = o if state.p is None else take(state.p, index)
    radiance, pdf = lights.emitted(world.lights, x, at, d, None if state.n is None else take(state.n, index))
    if world.textures.emission is not None:
        radiance = radiance * emission_map(world, at)
    return _weighted(_arrived(state, hit, index), radiance, take(state.pdf, index), pdf)


def escape(world: World, state: PathState, hit: Hit, index: Tensor) -> Tensor:
    """Radiance ``(3, n)`` that the paths at ``index`` gather from the environment they escape to."""
    assert world.lights is not None
    radiance, pdf = lights.environment(world.lights, take(state.d, index))
    return _weighted(_arrived(state, hit, index), radiance, take(state.pdf, index), pdf)


def _arrived(state: PathState, hit: Hit, index: Tensor) -> Tensor:
    """Throughput ``(3, n)`` with the derivative of the chance that the rays came here."""
    throughput = take(state.throughput, index)
    return throughput if hit.chance is None else throughput * take(hit.chance, index)


def _weighted(throughput: Tensor, radiance: Tensor, pdf: Tensor, light_pdf: Tensor) -> Tensor:
    # PathState.pdf is inf where emission counts whole and 0 where it does not count: the heuristic's own limits.
    return throughput * radiance * power_heuristic(pdf, light_pdf).detach()


def bounce(
    plan: Plan,
    world: World,
    model: int,
    roulette: float,
    slide: bool,
    search: Callable[[PathState], Hit],
    state: PathState,
    hit: Hit,
    index: Tensor,
    salts: Tensor,
    pixel: Tensor | None = None,
) -> tuple[PathState, Hit | None, Shadow | None]:
    """One vertex of the paths at ``index``, all of which hit surfaces of one BSDF model.

    Args:
        plan: static needs.
        world: the scene's tensors.
        model: number of the BSDF model.
        roulette: the most that roulette lets paths survive with at this depth; 0: it does not play.
        slide: see :func:`torchpt.shapes.interact`.
        search: finds hits; called only where ``plan.attached``.
        state: of the whole wave.
        hit: of the whole wave.
        index: lanes concerned ``(n,)``.
        salts: names of this depth's dimensions.
        pixel: see :func:`torchpt.integrators.surfaces.texture_point_at`.

    Returns:
        The state of the ``n`` paths with their next rays, the next hits where they had to be found already, and the shadow
        rays whose light is still to be added (None where no light is sampled).
    """
    here, met = rows(state, index), rows(hit, index)
    at = interact(world, here.o, here.d, met, slide)
    if met.chance is not None:
        here = replace(here, throughput=here.throughput * met.chance)
    surface, shadow = shade(plan, world, model, here, at, salts, pixel)
    after, found = scatter(plan, world, model, here, at, surface, salts, roulette, search)
    return after, found, shadow


def shade(
    plan: Plan,
    world: World,
    model: int,
    state: PathState,
    at: Interaction,
    salts: Tensor,
    pixel: Tensor | None,
) -> tuple[Surface, Shadow | None]:
    """Resolve the material at the surface points and sample a light for each.

    Returns:
        The surface, and the shadow rays (None where no light is sampled).
    """
    surface, kind = surface_at(world, model, state.d, at, pixel), world.materials.models[model]
    if world.lights is None or plan.strategy in ("bsdf", "uniform") or kind.smooth:
        return surface, None
    table = world.lights
    draws = Draws(plan.sampler, state.key, salts)
    # The density of a light that a ray meets is asked for from where the ray left. That is where a reflected one will leave,
    # unless paths keep the vertex itself, or nothing that can be met shines.
    kept = lights.local(table) or table.row_of_prim is None
    x = at.p if kept else offset_origin(world, at, -state.d)
    n = None if kind.transmits else surface.frame.n
    drawn, which = draws.two(Dimension.LIGHT), None
    if table.choice is not None:
        # One number chooses the light and goes on to the place on it, so that both are stratified together.
        which = lights.fine(torch.stack((drawn[0], draws.one(Dimension.LIGHT_DIGITS))))
    u, mis = drawn.to(plan.dtype), plan.strategy == "mis"
    light = lights.sample(table, x, which, u, OFFSET, n, mis)
    wi = surface.frame.to_local(light.wi)
    weight = light.weight
    if plan.strategy == "mis":
        reflected, pdf = kind.eval_pdf(surface.parameters, surface.wo, wi)
        weight = weight * power_heuristic(light.pdf, pdf).detach()
    else:
        reflected = kind.eval(surface.parameters, surface.wo, wi)
    if _leaning(world, model):
        weight = weight * (_through(at, surface, light.wi, wi) > 0)
    if surface.shown is not None:
        weight = weight * surface.shown
    if surface.relief is not None:
        weight = weight * surface.relief.shadowing(light.wi)
    radiance = state.throughput * reflected * _shining(world, light) * weight
    o = offset_origin(world, at, light.wi)
    d = light.target - o
    lit = largest(radiance.detach().abs()) > 0
    t_max = lit.to(plan.dtype) * (1.0 - SHORTEN)
    if light.distant is not None:
        d = torch.where(light.distant, light.wi, d)
        t_max = torch.where(light.distant & lit, math.inf, t_max)
    return surface, Shadow(o, d, t_max, radiance)


def _shining(world: World, light: LightSample) -> Tensor:
    """Radiance ``(3, N)`` of the points on lights, textures of emission and opacity included."""
    if light.at is None:
        return light.radiance
    share = torch.ones_like(light.radiance)
    if world.textures.emission is not None:
        share = share * emission_map(world, light.at)
    if world.textures.opacity is not None:
        share = share * opacity_map(world, light.at)
    return light.radiance * (share if light.bare is None else torch.where(light.bare, 1.0, share))


def _leaning(world: World, model: int) -> bool:
    """Whether the shading normals of a model's surfaces may differ from the geometric ones."""
    textures = world.materials.textures[model]
    return world.geometry.normals is not None or (
        textures is not None and (textures.normal is not None or textures.bump is not None)
    )


def _through(at: Interaction, surface: Surface, world_wi: Tensor, wi: Tensor) -> Tensor:
    """Positive where a direction lies on the same side of both normals: a shading normal must not let light through."""
    same = dot(world_wi, at.ng) * wi[2]
    return same if surface.side is None else same * surface.side


def scatter(
    plan: Plan,
    world: World,
    model: int,
    state: PathState,
    at: Interaction,
    surface: Surface,
    salts: Tensor,
    roulette: float,
    search: Callable[[PathState], Hit],
) -> tuple[PathState, Hit | None]:
    """Draw the next direction from the BSDF and let roulette decide who goes on.

    Where derivatives with respect to geometry are wanted, the next hit is found here already, since the throughput must
    follow both ends of the ray; it is returned beside the state.
    """
    kind, frame, parameters, wo = world.materials.models[model], surface.frame, surface.parameters, surface.wo
    draws = Draws(plan.sampler, state.key, salts)
    u = draws.two(Dimension.BSDF).to(plan.dtype)
    if plan.strategy == "uniform" and not kind.delta:
        wi = uniform_sphere(u) if kind.transmits else uniform_hemisphere(u)
        pdf = torch.full_like(wi[2], (0.25 if kind.transmits else 0.5) / math.pi)
        drawn = BsdfSample(wi, pdf, kind.eval(parameters, wo, wi) / pdf)
    else:
        lobe = draws.one(Dimension.LOBE).to(plan.dtype) if kind.lobed else None
        drawn = kind.sample(parameters, wo, lobe, u)
    wi, pdf, weight = drawn.wi, drawn.pdf.detach(), drawn.weight
    sharp = torch.isinf(pdf) if kind.delta else None
    d = frame.to_world(wi).detach()
    o = offset_origin(world, at, d)
    # Least of what must be positive for the path to go on: comparisons cost more than minima.
    least = pdf
    if _leaning(world, model):
        least = torch.minimum(least, _through(at, surface, d, wi.detach()))
    if surface.shown is not None:
        least = torch.minimum(least, surface.shown)
    hit, forever = None, torch.finfo(torch.float32).max
    if plan.tape:
        # Detached sampling: direction and density are constants, the integrand follows the parameters.
        measure, alive = 1.0, least > 0
        follow = d
        if plan.attached:
            hit = search(replace(state, o=o, d=d, t_max=alive.to(plan.dtype) * forever))
            follow, measure = reattach(world, at.p, hit, d)
        if not kind.smooth:
            value = kind.eval(parameters, wo, frame.to_local(follow))
            again = value * (measure / torch.where(alive & ~torch.isinf(pdf), pdf, 1.0))
            weight = again if sharp is None else torch.where(sharp, weight, again)
        if plan.attached:
            # The direction of a delta follows the surface that it leaves; the next point slides along it.
            d = follow if sharp is None else torch.where(sharp, frame.to_world(wi), follow)
    if surface.relief is not None:
        weight = weight * surface.relief.shadowing(d)
    throughput = state.throughput * weight
    brightest = largest(throughput.detach())
    alive = torch.minimum(least, brightest) > 0
    eta = state.eta
    if eta is not None and drawn.eta is not None:
        eta = eta * drawn.eta.detach()
    if roulette:
        alive, throughput = survived(plan.rr_prob, roulette, draws, alive, throughput, brightest, eta)
    if hit is not None:
        hit = replace(hit, prim=torch.where(alive, hit.prim, -1))
    on = alive.to(plan.dtype)
    if plan.strategy == "mis" and world.lights is not None:
        counts = pdf
    else:
        alone = plan.strategy == "light" and world.lights is not None  # lights are not to be counted twice
        counts = torch.full_like(pdf, 0.0 if alone else math.inf)
        if alone and sharp is not None:
            counts = torch.where(sharp, pdf, counts)
    after = PathState(
        o=o,
        d=d,
        t_max=on * forever,
        throughput=throughput * on,
        radiance=state.radiance,
        pdf=counts,
        lane=state.lane,
        key=state.key,
        eta=eta,
    )
    if state.p is not None:
        n = torch.zeros_like(at.p) if kind.transmits else frame.n
        # Copies: no two tensors of a state share memory.
        after = replace(after, p=at.p.detach().clone(), n=n.detach().clone())
    return after, hit
