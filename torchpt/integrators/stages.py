"""The stages of the wavefront: pure functions of whole-wave tensors and an index of the lanes concerned.

Python ``if`` here asks only what the scene or the settings hold (:class:`Plan` is static), so a stage leaves out what is
not needed, and compiles to one graph whatever the number of lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from torch import Tensor

from torchpt import bsdfs, lights
from torchpt.cameras import Perspective
from torchpt.film import Filter
from torchpt.math.frames import Frame
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import dot, largest, take
from torchpt.math.warps import uniform_hemisphere
from torchpt.records import Hit, Interaction, PathState, World
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import interact, offset_origin, reattach
from torchpt.shapes.interaction import OFFSET

__all__ = [
    "STRATEGIES",
    "Plan",
    "Shadow",
    "Surface",
    "bounce",
    "emit",
    "escape",
    "generate",
    "rows",
    "scatter",
    "shade",
]

#: mis: light and BSDF sampling combined; bsdf, light: one of them; uniform: directions uniform over the hemisphere.
STRATEGIES = ("mis", "bsdf", "light", "uniform")

#: Shadow rays end this fraction of their length short of the light, beside the offset off its surface.
SHORTEN = 1e-4
#: Roulette never lets a path live on for sure: throughput above one would make it immortal.
SURVIVAL_CAP = 0.95

R = TypeVar("R", PathState, Hit)


@dataclass(frozen=True)
class Plan:
    """What a render asks of the stages; static."""

    sampler: str
    strategy: str
    rr_prob: float | None
    dtype: torch.dtype
    attached: bool  # whether derivatives with respect to geometry are wanted


@dataclass(frozen=True)
class Surface:
    """A surface point with its material resolved."""

    frame: Frame  # about the shading normal
    parameters: bsdfs.Parameters  # lane values of the BSDF
    wo: Tensor  # (3, N) local


@dataclass(frozen=True)
class Shadow:
    """Shadow rays and what the light brings where they pass."""

    o: Tensor  # (3, N)
    d: Tensor  # (3, N)
    t_max: Tensor  # (N,) 0 where the light brings nothing
    radiance: Tensor  # (3, N)


def rows(record: R, index: Tensor) -> R:
    """The lanes ``index`` of a record of tensors."""
    return type(record)(**{f.name: take(getattr(record, f.name), index) for f in fields(record)})


def generate(
    plan: Plan, camera: Perspective, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor
) -> PathState:
    """Camera rays through pixels ``x, y (N,)``, at places drawn from the filter."""
    place = filter.offset(Draws(plan.sampler, key, salts).two(Dimension.PIXEL)).to(plan.dtype)
    o, d = camera.rays(x + 0.5 + place[0], y + 0.5 + place[1])
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
    radiance, pdf = lights.emitted(world.lights, o, at, d)
    return _weighted(take(state.throughput, index), radiance, take(state.pdf, index), pdf)


def escape(world: World, state: PathState, index: Tensor) -> Tensor:
    """Radiance ``(3, n)`` that the paths at ``index`` gather from the environment they escape to."""
    assert world.lights is not None
    radiance, pdf = lights.environment(world.lights, take(state.d, index))
    return _weighted(take(state.throughput, index), radiance, take(state.pdf, index), pdf)


def _weighted(throughput: Tensor, radiance: Tensor, pdf: Tensor, light_pdf: Tensor) -> Tensor:
    # PathState.pdf is inf where emission counts whole and 0 where it does not count: the heuristic's own limits.
    return throughput * radiance * power_heuristic(pdf, light_pdf).detach()


def bounce(
    plan: Plan,
    world: World,
    model: int,
    roulette: bool,
    slide: bool,
    search: Callable[[PathState], Hit],
    state: PathState,
    hit: Hit,
    index: Tensor,
    salts: Tensor,
) -> tuple[PathState, Hit | None, Shadow | None]:
    """One vertex of the paths at ``index``, all of which hit surfaces of one BSDF model.

    Args:
        plan: static needs.
        world: the scene's tensors.
        model: number of the BSDF model.
        roulette: whether roulette plays at this depth.
        slide: see :func:`torchpt.shapes.interact`.
        search: finds hits; called only where ``plan.attached``.
        state: of the whole wave.
        hit: of the whole wave.
        index: lanes concerned ``(n,)``.
        salts: names of this depth's dimensions.

    Returns:
        The state of the ``n`` paths with their next rays, the next hits where they had to be found already, and the shadow
        rays whose light is still to be added (None where no light is sampled).
    """
    here = rows(state, index)
    at = interact(world, here.o, here.d, rows(hit, index), slide)
    surface, shadow = shade(plan, world, model, here, at, salts)
    after, found = scatter(plan, world, model, here, at, surface, salts, roulette, search)
    return after, found, shadow


def shade(
    plan: Plan, world: World, model: int, state: PathState, at: Interaction, salts: Tensor
) -> tuple[Surface, Shadow | None]:
    """Resolve the material at the surface points and sample a light for each.

    Returns:
        The surface, and the shadow rays (None where no light is sampled).
    """
    frame = Frame.about(at.ns)
    wo = frame.to_local(-state.d)
    parameters = bsdfs.gather(world.bsdfs[model], take(world.material, at.prim))
    surface = Surface(frame, parameters, wo)
    if world.lights is None or plan.strategy in ("bsdf", "uniform"):
        return surface, None
    table = world.lights
    kind = bsdfs.KINDS[world.models[model]]
    draws = Draws(plan.sampler, state.key, salts)
    choice = None if table.choice is None else draws.one(Dimension.LIGHT_CHOICE)
    light = lights.sample(table, at.p, choice, draws.two(Dimension.LIGHT).to(plan.dtype), OFFSET)
    wi = frame.to_local(light.wi)
    # A shading normal must not let light through the surface: wi on the same side of both normals.
    through = dot(light.wi, at.ng) * wi[2]
    reflected = kind.eval(parameters, wo, wi)
    weight = light.weight
    if plan.strategy == "mis":
        weight = weight * power_heuristic(light.pdf, kind.pdf(parameters, wo, wi)).detach()
    if world.normals is not None:
        weight = weight * (through > 0)
    radiance = state.throughput * reflected * light.radiance * weight
    o = offset_origin(world, at, light.wi)
    d = light.target - o
    lit = largest(radiance.detach().abs()) > 0
    t_max = lit.to(plan.dtype) * (1.0 - SHORTEN)
    if light.distant is not None:
        d = torch.where(light.distant, light.wi, d)
        t_max = torch.where(light.distant & lit, math.inf, t_max)
    return surface, Shadow(o, d, t_max, radiance)


def scatter(
    plan: Plan,
    world: World,
    model: int,
    state: PathState,
    at: Interaction,
    surface: Surface,
    salts: Tensor,
    roulette: bool,
    search: Callable[[PathState], Hit],
) -> tuple[PathState, Hit | None]:
    """Draw the next direction from the BSDF and let roulette decide who goes on.

    Where derivatives with respect to geometry are wanted, the next hit is found here already, since the throughput must
    follow both ends of the ray; it is returned beside the state.
    """
    name = world.models[model]
    kind = bsdfs.KINDS[name]
    frame, parameters, wo = surface.frame, surface.parameters, surface.wo
    draws = Draws(plan.sampler, state.key, salts)
    u = draws.two(Dimension.BSDF).to(plan.dtype)
    if plan.strategy == "uniform":
        wi = uniform_hemisphere(u)
        wi = torch.stack((wi[0], wi[1], torch.copysign(wi[2], wo[2])))
        pdf = torch.full_like(wi[2], 0.5 / math.pi)
        weight = kind.eval(parameters, wo, wi) / pdf
    else:
        lobe = draws.one(Dimension.LOBE) if name in bsdfs.LOBED else None
        drawn = kind.sample(parameters, wo, lobe, u)
        wi, pdf, weight = drawn.wi, drawn.pdf, drawn.weight
    d = frame.to_world(wi).detach()
    o = offset_origin(world, at, d)
    # Least of what must be positive for the path to go on: comparisons cost more than minima.
    least = pdf.detach()
    if world.normals is not None:
        least = torch.minimum(least, dot(d, at.ng) * wi[2])
    hit, forever = None, torch.finfo(torch.float32).max
    if plan.attached:
        # Detached sampling: direction and density are constants, the integrand follows the geometry.
        pdf = pdf.detach()
        alive = least > 0
        hit = search(replace(state, o=o, d=d, t_max=alive.to(plan.dtype) * forever))
        d, measure = reattach(world, at.p, hit, d)
        weight = kind.eval(parameters, wo, frame.to_local(d)) * (measure / torch.where(alive, pdf, 1.0))
    throughput = state.throughput * weight
    brightest = largest(throughput.detach())
    alive = torch.minimum(least, brightest) > 0
    if roulette:
        survival = (
            brightest.clamp_max(SURVIVAL_CAP) if plan.rr_prob is None else torch.full_like(brightest, plan.rr_prob)
        )
        alive = alive & (draws.one(Dimension.ROULETTE) < survival)
        throughput = throughput / torch.where(alive, survival, 1.0)
    if hit is not None:
        hit = replace(hit, prim=torch.where(alive, hit.prim, -1))
    on = alive.to(plan.dtype)
    if plan.strategy == "mis" and world.lights is not None:
        counts = pdf.detach()
    else:
        counts = torch.full_like(pdf, 0.0 if plan.strategy == "light" and world.lights is not None else math.inf)
    after = PathState(
        o=o,
        d=d,
        t_max=on * forever,
        throughput=throughput * on,
        radiance=state.radiance,
        pdf=counts,
        lane=state.lane,
        key=state.key,
    )
    return after, hit
