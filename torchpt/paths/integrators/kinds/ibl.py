"""A preview by the split-sum approximation: the first surface under prefiltered environment maps, plus lights with shadows.

The environment casts no shadows and there is no indirect light: that is the error of the preview. The split-sum approximation
is that of :mod:`torchpt.physics.ibl`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.core.tree import leaves
from torchpt.math.vectors import dot
from torchpt.paths import vertex as stages
from torchpt.paths.integrators.base import DARK_RIMS, LIGHT_CHOICE, SAMPLES
from torchpt.paths.integrators.first_surface import FirstSurface, FirstSurfaceIntegrator
from torchpt.paths.integrators.split_sum import shade_under
from torchpt.paths.state import StageContext, VertexInput, VertexOutput
from torchpt.physics import lights
from torchpt.physics.ibl.shading import IblMaps, Sky, maps
from torchpt.physics.ibl.table import brdf_table
from torchpt.physics.shapes import interact
from torchpt.physics.world import World

__all__ = ["Ibl", "Preview"]


class Ibl(FirstSurfaceIntegrator):
    """A preview: the first surface under the environment by split sum (unshadowed), and under other lights."""

    name = "ibl"
    parameters: ClassVar = {
        **LIGHT_CHOICE,
        **DARK_RIMS,
        **SAMPLES,
    }  # SAMPLES: `clamp` and `strict`, which treat each sample
    strategy = "light"

    def first(self, world: World) -> Preview:
        """Return the preview of a world, with its environment prefiltered."""
        return Preview.of(world)


@dataclass(frozen=True)
class Preview(FirstSurface):
    """Split-sum shading under the environment.

    Attributes:
        sky: prefiltered maps; None: no environment.
        turn: ``(3, 3)`` rotation from the world to the space of the maps; None: identity.
    """

    sky: Sky | None
    turn: Tensor | None = None

    @staticmethod
    def of(world: World) -> Preview:
        """Return the shading for a world; differentiable in its environment."""
        environment = lights.environment_image(world.lights)
        if environment is None:
            return Preview(sky=None)
        if environment.even:  # constant radiance: every prefiltered map is the image itself
            texels = environment.texels
            prefiltered = IblMaps(irradiance=texels, specular=(texels, texels), brdf=brdf_table().to(texels))
            return Preview(sky=Sky.of(prefiltered), turn=environment.turn)
        return Preview(sky=Sky.of(maps(environment.texels)), turn=environment.turn)

    def turned(self, d: Tensor) -> Tensor:
        """Return world directions ``(3, N)`` in the space of the maps."""
        return d if self.turn is None else torch.stack([dot(self.turn[k][:, None], d) for k in range(3)])

    def again(self, world: World) -> Preview:
        """Return the preview prefiltered anew if the environment requires gradients, else this one."""
        environment = None if world.lights is None else world.lights.environment
        return Preview.of(world) if any(t.requires_grad for t in leaves(environment)) else self

    def bounce(self, context: StageContext, model: int, vertex: VertexInput) -> VertexOutput:
        """Return the paths with split-sum radiance added, and shadow rays to the lights other than the environment."""
        world, state, hit = context.world, vertex.state, vertex.hit
        without_sky = replace(context, world=replace(world, lights=lights.without_environment(world.lights)))
        # `chance` is 1 with the derivative of the probability that the ray passed the surfaces before.
        throughput = state.throughput if hit.chance is None else state.throughput * hit.chance
        arriving = replace(state, throughput=throughput)
        at = interact(world, state.o, state.d, hit, follow_ray=context.follow_ray)
        surface, direct, shadow = stages.shade(without_sky, model, arriving, at)
        radiance = torch.zeros_like(state.radiance)
        if self.sky is not None:
            kind, wo = world.materials.models[model], -state.d
            if stages.has_shading_normals(world, model) and not kind.transmits:
                wo = surface.frame.to_world(surface.wo)  # on the side of the normal
            n, v = self.turned(surface.frame.n), self.turned(wo)
            radiance = throughput * shade_under(self.sky, kind, surface.parameters, n, v)
            if surface.front_mask is not None:
                radiance = radiance * surface.front_mask
        leaving = replace(state, radiance=state.radiance + radiance)
        return VertexOutput(leaving=leaving, next_hit=None, shadow=shadow, at=at, surface=surface, direct=direct)
