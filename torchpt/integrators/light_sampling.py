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
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import dot, largest
from torchpt.records import Interaction, LightSample, PathState, Shadow, World
from torchpt.samplers import Dimension, Draws
from torchpt.shapes import offset_origin
from torchpt.shapes.interaction import OFFSET

__all__ = ["held_back", "leaning", "light_radiance", "light_wish", "sample_light", "shade", "through"]

#: Shadow rays end this fraction of their length short of the light, beside the offset off its surface.
SHORTEN = 1e-4


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
    light = sample_light(plan, world, model, state, at, surface, salts)
    wi = surface.frame.to_local(light.wi)
    weight = light.weight
    if plan.strategy == "mis":
        reflected, pdf = kind.eval_pdf(surface.parameters, surface.wo, wi)
        weight = weight * power_heuristic(light.pdf, pdf).detach()
    else:
        reflected = kind.eval(surface.parameters, surface.wo, wi)
    weight = held_back(weight, world, model, at, surface, light.wi, wi)
    radiance = state.throughput * reflected * light_radiance(world, light) * weight
    return surface, _shadow_ray(plan, world, at, light, radiance, weight)


def held_back(
    weight: Tensor, world: World, model: int, at: Interaction, surface: Surface, light: Tensor, wi: Tensor
) -> Tensor:
    """A weight of light ``(n,)``, times what the surface lets pass before its BSDF is asked.

    Args:
        weight: of the light.
        world: the scene's tensors.
        model: number of the BSDF model.
        at: the points.
        surface: with its material.
        light: ``(3, n)`` direction to the light.
        wi: the same in the surface's frame.
    """
    if leaning(world, model):
        weight = weight * (through(at, surface, light, wi) > 0)
    if surface.shown is not None:
        weight = weight * surface.shown
    if surface.relief is not None:
        weight = weight * surface.relief.shadowing(light)
    return weight


def sample_light(
    plan: Plan, world: World, model: int, state: PathState, at: Interaction, surface: Surface, salts: Tensor
) -> LightSample:
    """A point on the lights for each surface point."""
    assert world.lights is not None
    x, which, numbers, n = light_wish(plan, world, model, state, at, surface, salts)
    return lights.sample(world.lights, x, which, numbers, OFFSET, n, plan.strategy == "mis")


def light_wish(
    plan: Plan, world: World, model: int, state: PathState, at: Interaction, surface: Surface, salts: Tensor
) -> tuple[Tensor, Tensor | None, Tensor, Tensor | None]:
    """What ``lights.sample`` is asked for each surface point: ``x (3, n)``, ``which (n,)``, ``u (2, n)``, ``n (3, n)``."""
    table = world.lights
    assert table is not None
    draws = Draws(plan.sampler, state.key, salts)
    # The density of a light that a ray meets is asked for from where the ray left. That is where a reflected one will leave,
    # unless paths keep the vertex itself, or nothing that can be met shines.
    kept = lights.local(table) or table.row_of_prim is None
    x = at.p if kept else offset_origin(world, at, -state.d)
    n = None if world.materials.models[model].transmits else surface.frame.n
    numbers, which = draws.two(Dimension.LIGHT), None
    if table.choice is not None:
        # One number chooses the light and goes on to the place on it, so that both are stratified together.
        which = lights.fine(torch.stack((numbers[0], draws.one(Dimension.LIGHT_DIGITS))))
    return x, which, numbers.to(plan.dtype), n


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
    """Whether the shading normals of a model's surfaces may differ from the geometric ones."""
    textures = world.materials.textures[model]
    return world.geometry.normals is not None or (
        textures is not None and (textures.normal is not None or textures.bump is not None)
    )


def through(at: Interaction, surface: Surface, world_wi: Tensor, wi: Tensor) -> Tensor:
    """Positive where a direction lies on the same side of both normals: a shading normal must not let light through."""
    same = dot(world_wi, at.ng) * wi[2]
    return same if surface.side is None else same * surface.side
