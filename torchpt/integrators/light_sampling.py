"""Next event estimation: a point on a light for each surface point, and what it brings there.

:func:`shade` = surface -> light -> shadow ray. Whether the ray is blocked is asked later, by whoever runs the stage.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt import lights
from torchpt.integrators.plan import Plan
from torchpt.integrators.surfaces import Surface, emission_map, opacity_map, surface_at
from torchpt.integrators.vertex import DirectLight, StageContext
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import dot, largest
from torchpt.records import Interaction, LightSample, PathState, Shadow, World
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import offset_origin
from torchpt.shapes.interaction import OFFSET

__all__ = ["leaning", "light_radiance", "sample_light", "shade", "shared", "through"]

#: Shadow rays end this fraction of their length short of the light, beside the offset off its surface.
SHORTEN = 1e-4


def shade(
    context: StageContext, model: int, state: PathState, at: Interaction
) -> tuple[Surface, DirectLight | None, Shadow | None]:
    """Resolve the material at surface points of a BSDF model and sample a light for each.

    Returns:
        The surface; the light and the shadow rays to it (None where no light is sampled).
    """
    plan, world = context.plan, context.world
    surface, kind = surface_at(world, model, state.d, at, context.pixel), world.materials.models[model]
    if world.lights is None or plan.strategy in ("bsdf", "uniform") or kind.smooth:
        return surface, None, None
    light = sample_light(context, model, state, at, surface)
    wi = surface.frame.to_local(light.wi)
    weight, pdf, heuristic = light.weight, None, None
    if plan.strategy == "mis":
        reflected, pdf = kind.eval_pdf(surface.parameters, surface.wo, wi)
        heuristic = power_heuristic(light.pdf, pdf).detach()
        weight = weight * heuristic
    else:
        reflected = kind.eval(surface.parameters, surface.wo, wi)
    share = shared(world, model, at, surface, light.wi, wi)
    weight = weight if share is None else weight * share
    shining = light_radiance(world, light)
    radiance = state.throughput * reflected * shining * weight
    direct = DirectLight(light, shining, reflected, share, pdf, heuristic)
    return surface, direct, _shadow_ray(plan, world, at, light, radiance, weight)


def shared(world: World, model: int, at: Interaction, surface: Surface, light: Tensor, wi: Tensor) -> Tensor | None:
    """Return the share ``(n,)`` of light that a surface lets pass before its BSDF is asked; None: all.

    Args:
        world: the scene's tensors.
        model: number of the BSDF model.
        at: the points.
        surface: with its material.
        light: ``(3, n)`` direction to the light.
        wi: the same in the surface's frame.
    """
    share: Tensor | None = None
    if leaning(world, model):
        share = (through(at, surface, light, wi) > 0).to(wi.dtype)
    if surface.shown is not None:
        share = surface.shown if share is None else share * surface.shown
    if surface.relief is not None:
        shadowing = surface.relief.shadowing(light)
        share = shadowing if share is None else share * shadowing
    return share


def sample_light(context: StageContext, model: int, state: PathState, at: Interaction, surface: Surface) -> LightSample:
    """Sample a point on the lights for each surface point."""
    plan, world = context.plan, context.world
    table = world.lights
    assert table is not None
    draws = Draws(plan.sampler, state.key, context.salts)
    # The density of a light that a ray meets is asked for from where the ray left. That is where a reflected one will leave,
    # unless paths keep the vertex itself, or nothing that can be met shines.
    kept = lights.local(table) or table.row_of_prim is None
    x = at.p if kept else offset_origin(world, at, -state.d)
    n = None if world.materials.models[model].transmits else surface.frame.n
    numbers, which = draws.two(Dimension.LIGHT), None
    if table.choice is not None:
        # One number chooses the light and goes on to the place on it, so that both are stratified together.
        which = lights.fine(torch.stack((numbers[0], draws.one(Dimension.LIGHT_DIGITS))))
    return lights.sample(table, x, which, numbers.to(plan.dtype), OFFSET, n, plan.strategy == "mis")


def light_radiance(world: World, light: LightSample) -> Tensor:
    """Radiance ``(3, N)`` of the points on lights, textures of emission and opacity included."""
    if light.at is None:
        return light.radiance
    share = torch.ones_like(light.radiance)
    if world.textures.emission is not None:
        share = share * emission_map(world, light.at)
    if world.textures.opacity is not None:
        share = share * opacity_map(world, light.at)
    return light.radiance * (share if light.bare is None else torch.where(light.bare, 1.0, share))


def _shadow_ray(
    plan: Plan, world: World, at: Interaction, light: LightSample, radiance: Tensor, weight: Tensor
) -> Shadow:
    """The ray to a point on a light that brings ``radiance``; of length 0 where that is none.

    Under a tape it is of length 0 where the sample has no ``weight (n,)``: a colour that is 0 has a derivative.
    """
    o = offset_origin(world, at, light.wi)
    d = light.target - o
    lit = (weight.detach() if plan.tape else largest(radiance.detach().abs())) > 0
    t_max = lit.to(plan.dtype) * (1.0 - SHORTEN)
    if light.distant is not None:
        d = torch.where(light.distant, light.wi, d)
        t_max = torch.where(light.distant & lit, math.inf, t_max)
    return Shadow(o, d, t_max, radiance)


def leaning(world: World, model: int) -> bool:
    """Return True where the shading normals of a model's surfaces may differ from the geometric ones."""
    textures = world.materials.textures[model]
    return world.geometry.normals is not None or (
        textures is not None and (textures.normal is not None or textures.bump is not None)
    )


def through(at: Interaction, surface: Surface, world_wi: Tensor, wi: Tensor) -> Tensor:
    """Positive where a direction lies on the same side of both normals: a shading normal must not let light through."""
    same = dot(world_wi, at.ng) * wi[2]
    return same if surface.side is None else same * surface.side
