"""A preview by split sum: the first surface under the environment's prefiltered maps, and other lights with their shadows.

What the environment brings is not shadowed and no light is reflected twice: that is the preview's error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.accel import Accel
from torchpt.ibl import IblMaps, Sky, brdf_table, maps
from torchpt.integrators import stages as pure
from torchpt.integrators.compiled import Stages
from torchpt.integrators.path import Tally, gather_light, partition
from torchpt.integrators.search import Search
from torchpt.integrators.split_sum import under
from torchpt.integrators.stages import Plan
from torchpt.lights.choice import ByTree
from torchpt.math.distributions import Discrete
from torchpt.math.vectors import dot
from torchpt.records import Hit, Lights, PathState, Shadow, World, rows
from torchpt.samplers import salts
from torchpt.shapes import interact

__all__ = ["Preview", "first_hit", "shaded", "without_environment"]


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
        environment = None if world.lights is None else world.lights.environment
        if environment is None:
            return Preview(None)
        if isinstance(environment, Tensor):
            even = environment.expand(2, 1, 3)
            table = brdf_table().to(environment)
            return Preview(Sky.of(IblMaps(even, (even, even), table)))
        texels = (environment.texels * environment.scale).T.reshape(environment.height, environment.width, 3)
        return Preview(Sky.of(maps(texels)), environment.turn)

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
    local = replace(world, lights=without_environment(world.lights))
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


def without_environment(lights: Lights | None) -> Lights | None:
    """The table without its last row, where that is the environment; None where nothing is left."""
    if lights is None or lights.environment is None:
        return lights
    left = len(lights.area) - 1
    if not left:
        return None
    columns = ("p0", "e1", "e2", "normal", "flip", "area", "bound", "radiance", "opacity", "quadric", "prim", "kind")
    cut = {name: getattr(lights, name) for name in columns}
    cut = {name: None if value is None else value[..., :left] for name, value in cut.items()}
    cut["solid"] = None if lights.solid is None else lights.solid[:left]
    choice = lights.choice
    if left == 1 or choice is None:
        return replace(lights, **{**cut, "kind": None}, kinds=lights.kinds[:1], choice=None, environment=None)
    if isinstance(choice, ByTree):
        beside = choice.beside
        assert beside is not None  # the environment is infinitely far, so not of the tree
        choice = replace(choice, beside=None if len(beside.pmf) == 2 else _without_last(beside))
    else:
        choice = _without_last(choice)
    return replace(lights, **cut, kinds=lights.kinds[:-1], choice=choice, environment=None)


def _without_last(choice: Discrete) -> Discrete:
    return Discrete.of(choice.pmf[:-1], choice.pmf.dtype)
