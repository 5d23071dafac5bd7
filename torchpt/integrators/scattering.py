"""Where a path goes behind a surface, and whether it does.

:func:`scatter` = :func:`draw` (BSDF sampling) -> :func:`attach` (only under derivatives) -> :func:`carry_on` (throughput and
roulette) -> :func:`next_ray`. Each hands a record to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.integrators.light_sampling import leaning, through
from torchpt.integrators.plan import FOREVER, Plan
from torchpt.integrators.roulette import chance_of, survived
from torchpt.integrators.surfaces import Surface
from torchpt.integrators.vertex import Drawn, StageContext
from torchpt.math.vectors import largest
from torchpt.math.warps import uniform_hemisphere, uniform_sphere
from torchpt.records import BsdfSample, Hit, Interaction, PathState
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import offset_origin, reattach

__all__ = ["Onward", "attach", "carry_on", "draw", "next_ray", "scatter"]


@dataclass(frozen=True)
class Onward:
    """Quantities that paths carry on, after roulette."""

    alive: Tensor  # (n,) bool
    throughput: Tensor  # (3, n)
    eta: Tensor | None  # see PathState
    carried: Tensor  # (3, n) throughput before roulette
    chance: Tensor | None  # (n,) to survive roulette; None where it does not play


def scatter(
    context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface
) -> tuple[PathState, Hit | None, Drawn, Onward]:
    """Draw the next direction from the BSDF and let roulette decide who goes on.

    Where derivatives with respect to geometry are wanted, the next hit is found here already, since the throughput must
    follow both ends of the ray; it is returned beside the state.
    """
    plan = context.plan
    draws = Draws(plan.sampler, state.key, context.salts)
    drawn, hit = draw(context, model, at, surface, draws), None
    if plan.tape:
        drawn, hit = attach(context, model, state, at, surface, drawn)
    onward = carry_on(plan, state, surface, drawn, draws, context.roulette)
    if hit is not None:
        hit = replace(hit, prim=torch.where(onward.alive, hit.prim, -1))
    return next_ray(context, model, state, at, surface, drawn, onward), hit, drawn, onward


def draw(context: StageContext, model: int, at: Interaction, surface: Surface, draws: Draws) -> Drawn:
    """Draw a direction from the BSDF, or from the hemisphere (strategy ``uniform``), and the ray that leaves along it."""
    plan, world = context.plan, context.world
    kind = world.materials.models[model]
    u = draws.two(Dimension.BSDF).to(plan.dtype)
    if plan.strategy == "uniform" and not kind.delta:
        wi = uniform_sphere(u) if kind.transmits else uniform_hemisphere(u)
        pdf = torch.full_like(wi[2], (0.25 if kind.transmits else 0.5) / math.pi)
        sample = BsdfSample(wi, pdf, kind.eval(surface.parameters, surface.wo, wi) / pdf)
    else:
        lobe = draws.one(Dimension.LOBE).to(plan.dtype) if kind.lobed else None
        sample = kind.sample(surface.parameters, surface.wo, lobe, u)
    pdf = sample.pdf.detach()
    sharp = torch.isinf(pdf) if kind.delta else None
    d = surface.frame.to_world(sample.wi).detach()
    o = offset_origin(world, at, d)
    # Least of what must be positive for the path to go on: comparisons cost more than minima.
    least = pdf
    if leaning(world, model):
        least = torch.minimum(least, through(at, surface, d, sample.wi.detach()))
    if surface.shown is not None:
        least = torch.minimum(least, surface.shown)
    return Drawn(o, d, sample.wi, pdf, sample.weight, least, sharp, sample.eta)


def attach(
    context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface, drawn: Drawn
) -> tuple[Drawn, Hit | None]:
    """Return what was drawn with derivatives: direction and density are constants, the integrand follows the parameters.

    Where geometry is differentiated (``plan.attached``) the next hit is found, and the direction follows both of its ends.
    """
    plan, world = context.plan, context.world
    kind, frame = world.materials.models[model], surface.frame
    d, weight, pdf, sharp = drawn.d, drawn.weight, drawn.pdf, drawn.sharp
    hit, follow, measure, alive = None, d, 1.0, drawn.least > 0
    if plan.attached:
        hit = context.search(replace(state, o=drawn.o, d=d, t_max=alive.to(plan.dtype) * FOREVER))
        follow, measure = reattach(world, at.p, hit, d)
    if not kind.smooth:
        value = kind.eval(surface.parameters, surface.wo, frame.to_local(follow))
        again = value * (measure / torch.where(alive & ~torch.isinf(pdf), pdf, 1.0))
        weight = again if sharp is None else torch.where(sharp, weight, again)
    if plan.attached:
        # The direction of a delta follows the surface that it leaves; the next point slides along it.
        d = follow if sharp is None else torch.where(sharp, frame.to_world(drawn.wi), follow)
    return replace(drawn, d=d, weight=weight), hit


def carry_on(plan: Plan, state: PathState, surface: Surface, drawn: Drawn, draws: Draws, roulette: float) -> Onward:
    """Throughput behind the surface, and which paths go on: those that carry something, and that roulette lets live."""
    weight = drawn.weight
    if surface.relief is not None:
        weight = weight * surface.relief.shadowing(drawn.d)
    throughput = state.throughput * weight
    brightest = largest(throughput.detach())
    # Under a tape a path that carries nothing goes on: what it would meet is the derivative by a colour that is 0.
    alive = (drawn.least if plan.tape else torch.minimum(drawn.least, brightest)) > 0
    eta = state.eta
    if eta is not None and drawn.eta is not None:
        eta = eta * drawn.eta.detach()
    if not roulette:
        return Onward(alive, throughput, eta, throughput, None)
    chance = chance_of(plan.rr_prob, roulette, brightest, eta, plan.tape)
    alive, survivors = survived(chance, draws, alive, throughput)
    return Onward(alive, survivors, eta, throughput, chance)


def next_ray(
    context: StageContext,
    model: int,
    state: PathState,
    at: Interaction,
    surface: Surface,
    drawn: Drawn,
    onward: Onward,
) -> PathState:
    """Return the paths with the rays that leave the surface; those that ended have rays of length 0."""
    plan, world = context.plan, context.world
    on = onward.alive.to(plan.dtype)
    # What MIS is to know of the density, should the ray meet a light.
    if plan.strategy == "mis" and world.lights is not None:
        pdf = drawn.pdf
    else:
        alone = plan.strategy == "light" and world.lights is not None  # lights are not to be counted twice
        pdf = torch.full_like(drawn.pdf, 0.0 if alone else math.inf)
        if alone and drawn.sharp is not None:
            pdf = torch.where(drawn.sharp, drawn.pdf, pdf)
    # A path that carries what is not finite must not end unseen: no comparison holds for NaN, so it would count as dark.
    radiance = state.radiance if plan.tape else state.radiance + onward.throughput * 0.0
    leaving = PathState(
        o=drawn.o,
        d=drawn.d,
        t_max=on * FOREVER,
        throughput=onward.throughput * on,
        radiance=radiance,
        pdf=pdf,
        lane=state.lane,
        key=state.key,
        eta=onward.eta,
        extra=state.extra,
    )
    if state.p is None:
        return leaving
    n = torch.zeros_like(at.p) if world.materials.models[model].transmits else surface.frame.n
    # Copies: no two tensors of a state share memory.
    return replace(leaving, p=at.p.detach().clone(), n=n.detach().clone())
