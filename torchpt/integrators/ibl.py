"""A preview by split sum: the first surface under the environment's prefiltered maps, and other lights with their shadows.

What the environment brings is not shadowed and no light is reflected twice: that is the preview's error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt import lights
from torchpt.accel import Accel
from torchpt.ibl import IblMaps, Sky, brdf_table, maps
from torchpt.integrators import stages as pure
from torchpt.integrators.compiled import Stages
from torchpt.integrators.path import Tally, gather_light, partition
from torchpt.integrators.search import Search
from torchpt.integrators.split_sum import under
from torchpt.integrators.stages import Plan
from torchpt.math.vectors import dot
from torchpt.records import Hit, PathState, Shadow, World, rows
from torchpt.samplers import salts
from torchpt.shapes import interact

__all__ = ["Preview", "first_hit", "shaded"]


@dataclass(frozen=True)
class Preview:
    """The environment ready for split-sum shading.

    Attributes:
        sky: its maps; None where there is no environment.
        turn: ``(3, 3)`` from the world to the maps' own space; None where they are the same.
    """

    sky: Sky | None
    turn: Tensor | None = None

    @staticmethod
    def of(world: World) -> Preview:
        """Of a scene's environment; differentiable in it."""
        around = lights.surroundings(world.lights)
        if around is None:
            return Preview(None)
        if around.even:
            texels = around.texels
            return Preview(Sky.of(IblMaps(texels, (texels, texels), brdf_table().to(texels))), around.turn)
        return Preview(Sky.of(maps(around.texels)), around.turn)

    def turned(self, d: Tensor) -> Tensor:
        """Directions ``(3, N)`` of the world in the maps' own space."""
        return d if self.turn is None else torch.stack([dot(self.turn[k][:, None], d) for k in range(3)])


def first_hit(stages: Stages, preview: Preview, accel: Accel, state: PathState) -> tuple[Tensor, Tally]:
    """Radiance ``(3, N)`` along camera rays ``state``, and what it took."""
    plan, world = stages.plan, stages.world
    search = Search(accel, world, plan.sampler, plan.dtype)
    slide = plan.attached or plan.dtype == torch.float64
    hit = search.nearest(state, 1)
    tally = Tally(rays=len(state.lane))
    ends, groups = partition(world, hit)
    gather_light(stages, state, hit, ends, slide)
    salt = salts(1, state.lane.device)
    for model, index in groups:
        radiance, shadow = shaded(
            plan, world, preview, model, rows(state, index), rows(hit, index), salt, stages.pixel, slide
        )
        if shadow is not None:
            tally.rays += len(shadow.t_max)
            radiance = torch.addcmul(radiance, shadow.radiance, search.clear(shadow))
        state.radiance.scatter_add_(1, index.expand(3, -1), radiance)
    return state.radiance, tally


def shaded(
    plan: Plan,
    world: World,
    preview: Preview,
    model: int,
    state: PathState,
    hit: Hit,
    salts: Tensor,
    pixel: Tensor | None,
    slide: bool,
) -> tuple[Tensor, Shadow | None]:
    """What the environment brings to surfaces of one model ``(3, n)``, and the shadow rays to the other lights."""
    local = replace(world, lights=lights.without_environment(world.lights))
    if hit.chance is not None:
        state = replace(state, throughput=state.throughput * hit.chance)
    at = interact(world, state.o, state.d, hit, slide)
    surface, shadow = pure.shade(plan, local, model, state, at, salts, pixel)
    radiance = torch.zeros_like(state.radiance)
    if preview.sky is not None:
        n, v = preview.turned(surface.frame.n), preview.turned(-state.d)
        radiance = state.throughput * under(preview.sky, world.materials.models[model], surface.parameters, n, v)
        if surface.shown is not None:
            radiance = radiance * surface.shown
    return radiance, shadow
