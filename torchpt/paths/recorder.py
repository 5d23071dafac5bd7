"""Eager stages that keep what each of them was given and what it made of it.

A recorder takes the place of :class:`~torchpt.integrators.stage_runner.Stages` in a wave, and observes its walk. It
hands on what the stages themselves return; what they do not return (which light, the density of a direction) it asks again of
the same pure functions, which give the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from torchpt import lights
from torchpt.cameras import Camera
from torchpt.film import Filter
from torchpt.integrators.light_sampling import held_back, light_radiance, light_wish, sample_light
from torchpt.integrators.roulette import chance_of
from torchpt.integrators.scattering import Drawn, carry_on, draw
from torchpt.integrators.stage_runner import Stages
from torchpt.integrators.stages import shining
from torchpt.integrators.surfaces import Surface, surface_at
from torchpt.math.mis import power_heuristic
from torchpt.math.vectors import largest, take
from torchpt.paths.walk import Observer, Population
from torchpt.records import Hit, Interaction, LightSample, PathState, Shadow, rows
from torchpt.samplers import Draws
from torchpt.shapes import interact

__all__ = ["Bounced", "Left", "Lit", "Met", "Record", "Recorder", "Shone"]


@dataclass(frozen=True)
class Left:
    """Camera rays, as they left.

    Attributes:
        lanes: ``(n,)`` int64 places in the wave, as in all records.
        state: of them.
    """

    lanes: Tensor
    state: PathState


@dataclass(frozen=True)
class Met:
    """What rays met at a vertex.

    Attributes:
        depth: of the vertex, from 1.
        lanes: ``(n,)``.
        state: with which they came; its radiance is that before the vertex.
        hit: what the search found.
    """

    depth: int
    lanes: Tensor
    state: PathState
    hit: Hit


@dataclass(frozen=True)
class Shone:
    """Light that paths met by chance.

    Attributes:
        depth: of the vertex.
        lanes: ``(n,)``.
        slot: ``(n,)`` of the surface, see :class:`~torchpt.records.Interaction`; None: it is the environment.
        radiance: ``(3, n)`` of the light.
        pdf: ``(n,)`` with which it would have been sampled.
        weight: ``(n,)`` of MIS.
        brought: ``(3, n)`` to the sample.
    """

    depth: int
    lanes: Tensor
    slot: Tensor | None
    radiance: Tensor
    pdf: Tensor
    weight: Tensor
    brought: Tensor


@dataclass(frozen=True)
class Lit:
    """Light that was sampled at a vertex.

    Attributes:
        row: ``(n,)`` int64 in the table of lights.
        sample: of it.
        radiance: ``(3, n)`` of the light, with its textures.
        reflected: ``(3, n)`` what the BSDF, with the cosine, makes of it.
        share: ``(n,)`` of that: less than 1 where normals lean, and 0 on a back that is black.
        pdf: ``(n,)`` with which the BSDF would have drawn the direction.
        weight: ``(n,)`` of MIS.
        brought: ``(3, n)`` to the sample if nothing is in the way.
    """

    row: Tensor
    sample: LightSample
    radiance: Tensor
    reflected: Tensor
    share: Tensor
    pdf: Tensor
    weight: Tensor
    brought: Tensor


@dataclass(frozen=True)
class Bounced:
    """A vertex from which paths may go on.

    Attributes:
        depth: of it.
        lanes: ``(n,)``.
        model: number of the BSDF model.
        at: the points.
        surface: with its material.
        lit: None where no light is sampled.
        drawn: the direction that the BSDF gave.
        carried: ``(3, n)`` throughput before roulette.
        chance: ``(n,)`` to survive roulette; None where it does not play.
        after: how the paths go on; ``t_max`` is 0 where they ended.
    """

    depth: int
    lanes: Tensor
    model: int
    at: Interaction
    surface: Surface
    lit: Lit | None
    drawn: Drawn
    carried: Tensor
    chance: Tensor | None
    after: PathState


Record = Left | Met | Shone | Bounced


class Legible(Population, Protocol):
    """Paths whose tensors may be looked at."""

    @property
    def state(self) -> PathState:
        """Of the paths as they arrive."""
        ...

    @property
    def met(self) -> Hit:
        """What their rays met."""
        ...

    @property
    def clear(self) -> list[Tensor]:
        """How much gets through of the light that was sampled at the vertex before, for each of its models."""
        ...


class Recorder(Stages, Observer[Legible]):
    """Stages that keep records; to be used for one wave of few lanes.

    Args:
        stages: whose plan, world and pixel it takes.

    Attributes:
        records: what happened, in order.
        clear: by record of a vertex in ``records`` how much of its light gets through ``(n,)``.
    """

    def __init__(self, stages: Stages) -> None:
        super().__init__(stages.plan, stages.world, stages.pixel)
        self.records: list[Record] = []
        self.clear: dict[int, Tensor] = {}
        self._depth = 1
        self._lit: list[int] = []

    def keep(self, record: Record) -> None:
        """Told of every record."""
        self.records.append(record)

    def generate(self, camera: Camera, filter: Filter, x: Tensor, y: Tensor, key: Tensor, salts: Tensor) -> PathState:
        """See :class:`Stages`."""
        state = super().generate(camera, filter, x, y, key, salts)
        self.keep(Left(state.lane, state))
        return state

    def arrived(self, paths: Legible) -> bool:
        """See :class:`Observer`."""
        self.clear |= zip(self._lit, paths.clear, strict=True)
        self._lit = []
        self._depth, state = paths.depth, paths.state
        self.keep(Met(paths.depth, state.lane, replace(state, radiance=state.radiance.clone()), paths.met))
        return False

    def emit(self, state: PathState, hit: Hit, index: Tensor, slide: bool) -> Tensor:
        """See :class:`Stages`."""
        brought = super().emit(state, hit, index, slide)
        slot = self.world.geometry.slot(take(hit.prim, index))
        self._shone(state, index, slot, shining(self.world, state, hit, index, slide), brought)
        return brought

    def escape(self, state: PathState, hit: Hit, index: Tensor) -> Tensor:
        """See :class:`Stages`."""
        brought = super().escape(state, hit, index)
        assert self.world.lights is not None
        self._shone(state, index, None, lights.environment(self.world.lights, take(state.d, index)), brought)
        return brought

    def _shone(
        self, state: PathState, index: Tensor, slot: Tensor | None, light: tuple[Tensor, Tensor], brought: Tensor
    ) -> None:
        weight = power_heuristic(take(state.pdf, index), light[1])
        self.keep(Shone(self._depth, take(state.lane, index), slot, *light, weight, brought))

    def bounce(
        self,
        model: int,
        roulette: float,
        slide: bool,
        search: Callable[[PathState], Hit],
        state: PathState,
        hit: Hit,
        index: Tensor,
        salts: Tensor,
    ) -> tuple[PathState, Hit | None, Shadow | None]:
        """See :class:`Stages`."""
        result = super().bounce(model, roulette, slide, search, state, hit, index, salts)
        plan, world = self.plan, self.world
        arriving = rows(state, index)
        at = interact(world, arriving.o, arriving.d, rows(hit, index), slide)
        surface = surface_at(world, model, arriving.d, at, self.pixel)
        lit = None if result[2] is None else self._lit_of(model, arriving, at, surface, salts, result[2])
        draws = Draws(plan.sampler, arriving.key, salts)
        drawn = draw(plan, world, model, at, surface, draws)
        onward, chance = carry_on(plan, arriving, surface, drawn, draws, 0.0), None
        if roulette:
            chance = chance_of(plan.rr_prob, roulette, largest(onward.throughput), onward.eta)
        after = result[0]
        if lit is not None:
            self._lit.append(len(self.records))
        self.keep(Bounced(self._depth, arriving.lane, model, at, surface, lit, drawn, onward.throughput, chance, after))
        return result

    def _lit_of(
        self, model: int, state: PathState, at: Interaction, surface: Surface, salts: Tensor, shadow: Shadow
    ) -> Lit:
        """What is known of the light that was sampled."""
        plan, world, kind = self.plan, self.world, self.world.materials.models[model]
        assert world.lights is not None
        x, which, _, n = light_wish(plan, world, model, state, at, surface, salts)
        sample = sample_light(plan, world, model, state, at, surface, salts)
        row = lights.chosen(world.lights, which, x, n)
        wi = surface.frame.to_local(sample.wi)
        reflected, pdf = kind.eval_pdf(surface.parameters, surface.wo, wi)
        weight = power_heuristic(sample.pdf, pdf) if plan.strategy == "mis" else torch.ones_like(pdf)
        share = held_back(torch.ones_like(pdf), world, model, at, surface, sample.wi, wi)
        return Lit(row, sample, light_radiance(world, sample), reflected, share, pdf, weight, shadow.radiance)
