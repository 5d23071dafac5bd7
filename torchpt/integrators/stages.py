"""The stages of the wavefront: pure functions of whole-wave tensors and an index of the lanes concerned.

Python ``if`` here asks only what the scene or the settings hold (:class:`~torchpt.integrators.plan.Plan` is static), so a stage
leaves out what is not needed, and compiles to one graph whatever the number of lanes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import take
from torchpt.records import Hit, PathState, Shadow, World, rows
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import interact

__all__ = ["STRATEGIES", "Plan", "bounce", "emit", "escape", "generate", "scatter", "shade", "shining"]


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


def emit(world: World, state: PathState, hit: Hit, index: Tensor | None, slide: bool) -> Tensor:
    """Radiance ``(3, n)`` that the paths at ``index`` (None: all) gather from the emitters they hit, weighted by MIS."""
    radiance, pdf = shining(world, state, hit, index, slide)
    return _weighted(_arrived(state, hit, index), radiance, take(state.pdf, index), pdf)


def shining(world: World, state: PathState, hit: Hit, index: Tensor | None, slide: bool) -> tuple[Tensor, Tensor]:
    """Radiance ``(3, n)`` of the emitters that the paths at ``index`` hit, and the density of sampling it ``(n,)``."""
    assert world.lights is not None
    o, d = take(state.o, index), take(state.d, index)
    at = interact(world, o, d, rows(hit, index), slide)
    # Where lights are chosen by place the density is that at the vertex itself, which is not quite where the ray begins.
    x = o if state.p is None else take(state.p, index)
    radiance, pdf = lights.emitted(world.lights, x, at, d, None if state.n is None else take(state.n, index))
    if world.textures.emission is not None:
        radiance = radiance * emission_map(world, at)
    return radiance, pdf


def escape(world: World, state: PathState, hit: Hit, index: Tensor | None) -> Tensor:
    """Radiance ``(3, n)`` that the paths at ``index`` (None: all) gather from the environment they escape to."""
    assert world.lights is not None
    radiance, pdf = lights.environment(world.lights, take(state.d, index))
    return _weighted(_arrived(state, hit, index), radiance, take(state.pdf, index), pdf)


def _arrived(state: PathState, hit: Hit, index: Tensor | None) -> Tensor:
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
    index: Tensor | None,
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
        index: lanes concerned ``(n,)``; None: all.
        salts: names of this depth's dimensions.
        pixel: see :func:`torchpt.integrators.surfaces.texture_point_at`.

    Returns:
        The state of the ``n`` paths with their next rays, the next hits where they had to be found already, and the shadow
        rays whose light is still to be added (None where no light is sampled).
    """
    arriving, met = rows(state, index), rows(hit, index)
    at = interact(world, arriving.o, arriving.d, met, slide)
    if met.chance is not None:
        arriving = replace(arriving, throughput=arriving.throughput * met.chance)
    surface, shadow = shade(plan, world, model, arriving, at, salts, pixel)
    leaving, next_hit = scatter(plan, world, model, arriving, at, surface, salts, roulette, search)
    return leaving, next_hit, shadow
