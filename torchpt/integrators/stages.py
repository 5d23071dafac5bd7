"""The stages of the wavefront: pure functions of lanes (:mod:`torchpt.integrators.vertex` has what they read and return).

Python ``if`` here asks only what the scene or the settings hold (:class:`~torchpt.integrators.plan.Plan` is static), so a stage
leaves out what is not needed, and compiles to one graph whatever the number of lanes.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchpt import lights
from torchpt.cameras import Camera
from torchpt.film import Filter
from torchpt.integrators.light_sampling import shade
from torchpt.integrators.plan import STRATEGIES, Plan
from torchpt.integrators.scattering import scatter
from torchpt.integrators.surfaces import emission_map
from torchpt.integrators.vertex import Emission, StageContext, VertexInput, VertexOutput
from torchpt.math.mis import power_heuristic
from torchpt.records import PathState
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import interact

__all__ = ["STRATEGIES", "Plan", "bounce", "emit", "escape", "generate", "scatter", "shade"]


def generate(plan: Plan, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
    """Camera rays through pixels ``x, y (N,)``, at places drawn from the filter (and on the lens, where there is one)."""
    draws = Draws(plan.sampler, key, salts)
    offset = filter.offset(draws.two(Dimension.PIXEL)).to(plan.dtype)
    lens = draws.two(Dimension.LENS).to(plan.dtype) if camera.lens else None
    o, d = camera.rays(x + 0.5 + offset[0], y + 0.5 + offset[1], lens)
    n = d.shape[1]
    ones = torch.ones_like(d)
    forever = torch.full((n,), math.inf, dtype=plan.dtype, device=d.device)
    lane = torch.arange(n, device=d.device)
    # No two tensors of a state share memory: `radiance` is added to in place.
    return PathState(o.expand(3, n).clone(), d, forever, ones, torch.zeros_like(d), forever.clone(), lane, key)


def emit(context: StageContext, vertex: VertexInput) -> Emission:
    """Return what paths gather from the emitters that they hit."""
    world, state = context.world, vertex.state
    assert world.lights is not None
    at = interact(world, state.o, state.d, vertex.hit, context.slide)
    # Where lights are chosen by place the density is that at the vertex itself, which is not quite where the ray begins.
    x = state.o if state.p is None else state.p
    radiance, pdf = lights.emitted(world.lights, x, at, state.d, state.n)
    if world.textures.emission is not None:
        radiance = radiance * emission_map(world, at)
    return _gathered(vertex, radiance, pdf)


def escape(context: StageContext, vertex: VertexInput) -> Emission:
    """Return what paths gather from the environment that they escape to."""
    assert context.world.lights is not None
    return _gathered(vertex, *lights.environment(context.world.lights, vertex.state.d))


def _gathered(vertex: VertexInput, radiance: Tensor, light_pdf: Tensor) -> Emission:
    state, hit = vertex.state, vertex.hit
    # With the derivative of the chance that the rays came here.
    throughput = state.throughput if hit.chance is None else state.throughput * hit.chance
    # PathState.pdf is inf where emission counts whole and 0 where it does not count: the heuristic's own limits.
    weight = power_heuristic(state.pdf, light_pdf).detach()
    return Emission(radiance, light_pdf, weight, throughput * radiance * weight)


def bounce(context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
    """Return what surfaces of one BSDF model make of paths: light that is sampled, the next ray, roulette."""
    world, state, hit = context.world, vertex.state, vertex.hit
    at = interact(world, state.o, state.d, hit, context.slide)
    if hit.chance is not None:
        state = replace(state, throughput=state.throughput * hit.chance)
    surface, direct, shadow = shade(context, model, state, at)
    leaving, following, drawn, onward = scatter(context, model, state, at, surface)
    return VertexOutput(leaving, following, shadow, at, surface, direct, drawn, onward.carried, onward.chance)
