"""A preview by split sum: the first surface under the environment's prefiltered maps, and other lights with their shadows.

What the environment brings is not shadowed and no light is reflected twice: that is the preview's error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.ibl import IblMaps, Sky, brdf_table, maps
from torchpt.integrators import stages as pure
from torchpt.integrators.base import LIGHT_CHOICE, SAMPLES
from torchpt.integrators.first_surface import FirstSurface, FirstSurfaceIntegrator
from torchpt.integrators.split_sum import under
from torchpt.integrators.stages import Plan
from torchpt.lights.choice import ByTree
from torchpt.math.distributions import Discrete
from torchpt.math.vectors import dot
from torchpt.records import Hit, Lights, PathState, Shadow, World, tensors_of
from torchpt.shapes import interact

__all__ = ["Ibl", "Preview", "without_environment"]


class Ibl(FirstSurfaceIntegrator):
    """A preview: the first surface under the environment by split sum (unshadowed), and under other lights."""

    name = "ibl"
    parameters: ClassVar = {**LIGHT_CHOICE, **SAMPLES}
    strategy = "light"

    def first(self, world: World) -> Preview:
        """See :class:`Integrator`."""
        return Preview.of(world)


@dataclass(frozen=True)
class Preview(FirstSurface):
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

    def again(self, world: World) -> Preview:
        """See :class:`FirstSurface`."""
        environment = None if world.lights is None else world.lights.environment
        return Preview.of(world) if any(t.requires_grad for t in tensors_of(environment)) else self

    def shade(
        self,
        plan: Plan,
        world: World,
        model: int,
        state: PathState,
        hit: Hit,
        salts: Tensor,
        pixel: Tensor | None,
        slide: bool,
    ) -> tuple[Tensor, Shadow | None]:
        """See :class:`FirstSurface`."""
        local = replace(world, lights=without_environment(world.lights))
        if hit.chance is not None:
            state = replace(state, throughput=state.throughput * hit.chance)
        at = interact(world, state.o, state.d, hit, slide)
        surface, shadow = pure.shade(plan, local, model, state, at, salts, pixel)
        radiance = torch.zeros_like(state.radiance)
        if self.sky is not None:
            n, v = self.turned(surface.frame.n), self.turned(-state.d)
            radiance = state.throughput * under(self.sky, world.materials.models[model], surface.parameters, n, v)
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
