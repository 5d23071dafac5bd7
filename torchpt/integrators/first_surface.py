"""Integrators that stop at the first surface: one vertex, with at most one shadow ray from it."""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from torchpt.accel import Accel
from torchpt.integrators.base import Integrator
from torchpt.integrators.path import gather_light, partition
from torchpt.integrators.search import Search
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.stages import Plan
from torchpt.integrators.tally import Tally
from torchpt.records import Hit, PathState, Shadow, World, rows
from torchpt.samplers import salts

__all__ = ["FirstSurface", "FirstSurfaceIntegrator"]


class FirstSurface(ABC):
    """What happens at first surfaces.

    Implementations are frozen dataclasses: kernels read their tensors as tables, and are made anew where another field differs.
    """

    def again(self, world: World) -> FirstSurface:
        """The same for its world under a tape: made anew where a derivative goes through it."""
        return self

    def shadows(self, world: World) -> bool:
        """Whether :meth:`shade` gives shadow rays for any model."""
        return world.lights is not None

    @abstractmethod
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
        """What surfaces of one model bring: pure, of n lanes.

        Args:
            plan: static needs.
            world: the scene's tensors.
            model: number of the BSDF model.
            state: camera rays.
            hit: what they met.
            salts: names of the dimensions.
            pixel: see :func:`torchpt.integrators.surfaces.texture_point_at`.
            slide: see :func:`torchpt.shapes.interact`.

        Returns:
            Radiance ``(3, n)``, and shadow rays whose light is still to be added (None: there are none).
        """


class FirstSurfaceIntegrator(Integrator):
    """Integrators whose radiance is what :meth:`first` says of the first surface, and what shines there by itself."""

    looped = True

    def radiance(self, stages: Stages, accel: Accel, state: PathState, first: FirstSurface, tally: Tally) -> Tensor:
        """See :class:`Integrator`."""
        plan, world = stages.plan, stages.world
        search = Search(accel, world, plan.sampler, plan.dtype)
        slide = plan.attached or plan.dtype == torch.float64
        hit = search.nearest(state, 1)
        tally.rays += len(state.lane)
        stages.met(1, state, hit)
        ends, groups = partition(world, hit)
        gather_light(stages, state, hit, ends, slide)
        salt = salts(1, state.lane.device)
        for model, index in groups:
            here, met = rows(state, index), rows(hit, index)
            radiance, shadow = first.shade(plan, world, model, here, met, salt, stages.pixel, slide)
            if shadow is not None:
                tally.rays += len(here.lane)
                radiance = torch.addcmul(radiance, shadow.radiance, search.clear(shadow))
            state.radiance.scatter_add_(1, index.expand(3, -1), radiance)
        return state.radiance
