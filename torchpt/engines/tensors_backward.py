"""The backward engine of tensor operations: for CUDA, float64, and stages that cannot be compiled.

Cotangents between vertices are stored by sample: the VJP of a vertex reads the cotangents of the rays that left it, and writes
those of the rays that came.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.core.memory import Span
from torchpt.engines.tensors import Paths, TensorsEngine, escaped
from torchpt.math.gathers import recording_gathers
from torchpt.math.sums import GradientSums
from torchpt.math.vectors import rows, take
from torchpt.paths import adjoint
from torchpt.paths.adjoint import Tape, VertexCotangents
from torchpt.paths.integrators.path import Ends, follows_ray
from torchpt.paths.state import EXTRA, Emission, PathState, Shadow, Splat, StageContext, VertexInput
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit

__all__ = ["TensorsBackward"]


class TensorsBackward(TensorsEngine):
    """Backward engine of tensor operations; see :class:`torchpt.engines.engine.Backward`.

    Args:
        tape: the wave and its differentiated tensors.
        cotangent: ``(3, H W)`` of the picture, divided by the samples a pixel, for the VJP of splats.
    """

    def __init__(self, tape: Tape, cotangent: Tensor | None = None) -> None:
        super().__init__(tape.wave, 0)
        self.tape, self.taped, self._cotangent = tape, tape.taped, cotangent
        # Traces rays through differentiated opacity on a tape.
        self._under_tape = TensorsEngine(replace(tape.wave, context=tape.taped.context), 0)
        self._rows = ("throughput", "o", "d") if self.plan.attached else ("throughput",)

    def begin(self, span: Span, sums: GradientSums) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        self.sums, self._span = sums, span
        state = self.wave.rays(*span)
        self._clear(len(state.lane))
        self._weight = self.wave.weight(state) if self.wave.filter.signed else None
        return self.spawn(state)

    def mark(self, paths: Paths) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        return Paths(paths.state, paths.depth, paths.hit)

    def resume(self, mark: Paths) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        state = replace(mark.state, radiance=torch.zeros_like(mark.state.radiance))
        return Paths(state, mark.depth, mark.hit)

    def scatter(self, paths: Paths, roulette: float) -> Paths:
        """See :class:`torchpt.paths.walk.Engine`. The transmittance of shadow rays is kept with the vertex that they leave."""
        after = super().scatter(paths, roulette)
        paths.passed = after.transmittance, after.splat_transmittance
        return after

    def radiance_of_samples(self) -> Tensor:
        """See :class:`torchpt.engines.engine.Backward`."""
        found = self.path_radiance()
        return found if self._weight is None else found * self._weight

    def receive(self, cotangent: Tensor) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        # By sample: cotangents of the radiance and of the ray that leaves the vertex at hand, and the hit of that ray.
        self._radiance_cotangent = cotangent if self._weight is None else cotangent * self._weight
        self._ray_cotangents = {name: torch.zeros_like(cotangent) for name in self._rows}
        for own in self.wave.integrator.fields:
            if not own.whole:
                self._ray_cotangents[EXTRA + own.name] = torch.zeros_like(own.begin(cotangent[0]))
        zero = torch.zeros_like(cotangent[0])
        none = torch.full(zero.shape, -1, dtype=torch.int64, device=zero.device)
        self._met = Hit(zero.clone(), none, zero.clone(), zero.clone())

    def vjp(self, paths: Paths) -> None:
        """See :class:`torchpt.engines.engine.Backward`. Lanes are sorted by sample, the order in which gradients are added."""
        depth, order = paths.depth, paths.state.lane.argsort()
        place = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=order.device))
        state, hit = rows(paths.state, order), rows(paths.hits, order)
        ends = Ends(take(place, paths.ends.emissive).msort(), take(place, paths.ends.missed).msort())
        chance, chance_cotangent = self._chance(state, depth)
        hit = replace(hit, chance=chance)
        if depth < self.wave.integrator.limits.last:
            transmittance, splat_transmittance = (iter(kept) for kept in paths.passed)
            for model, came in paths.groups or ():
                index, turn = take(place, came).sort()
                self._bounce(
                    model, depth, transmittance, splat_transmittance, turn, state, hit, index, chance_cotangent
                )
        self._light(ends, depth, state, hit, chance_cotangent)
        if chance is not None and chance_cotangent is not None:
            self.sums.add_each(torch.autograd.grad(chance, self.tape.tables, chance_cotangent, allow_unused=True))
        if self.plan.attached:
            for name in ("t", "prim", "u", "v"):
                getattr(self._met, name).index_copy_(0, state.lane, getattr(hit, name))

    def _chance(self, state: PathState, depth: int) -> tuple[Tensor | None, Tensor | None]:
        """Return the probability factor of passed surfaces on a tape, with a zero cotangent to add to; None: no derivative."""
        if not self.tape.differentiates_opacity:
            return None, None
        with torch.enable_grad(), recording_gathers(self.sums):
            chance = self._under_tape.hits(state, depth).chance
        if chance is None or not chance.requires_grad:
            return None, None
        return chance, torch.zeros_like(chance)

    def _at(self, depth: int, lanes: Tensor, roulette: float = 0.0) -> StageContext:
        follow_ray = follows_ray(self.plan, self.taped.context.world, depth)
        return self.taped.context.at(salts(depth, lanes.device), follow_ray, roulette)

    def _bounce(
        self,
        model: int,
        depth: int,
        transmittance: Iterator[Tensor],
        splat_transmittance: Iterator[Tensor],
        turn: Tensor,
        state: PathState,
        hit: Hit,
        index: Tensor,
        chance_cotangent: Tensor | None,
    ) -> None:
        """Pull cotangents back through the surfaces of a model, at lanes ``index``."""
        lane = take(state.lane, index)
        next_hit = rows(self._met, lane) if self.plan.attached else None
        cotangents = VertexCotangents(
            take(self._radiance_cotangent, lane),
            take(self._ray_cotangents["throughput"], lane),
            *(take(self._ray_cotangents[name], lane) if self.plan.attached else None for name in ("o", "d")),
            extra={
                k.removeprefix(EXTRA): take(x, lane) for k, x in self._ray_cotangents.items() if k.startswith(EXTRA)
            },
        )

        def passed(shadow: Shadow) -> Tensor:
            kept = next(transmittance)
            return self._under_tape.transmittance(shadow) if self.tape.differentiates_opacity else take(kept, turn)

        def landed(splat: Splat) -> tuple[Tensor, Tensor]:
            kept = next(splat_transmittance)
            through = (
                self._under_tape.transmittance(splat.light) if self.tape.differentiates_opacity else take(kept, turn)
            )
            assert self._cotangent is not None
            return adjoint.splat_contributions(self.wave.integrator.clamp, self._cotangent, splat, through)

        with recording_gathers(self.sums):
            context = self._at(depth, lane, self.wave.integrator.limits.roulette(depth))
            vertex = VertexInput(rows(state, index), rows(hit, index))
            stage = self.wave.integrator.bounce
            input_cotangents = adjoint.bounce_vjp(
                stage, context, model, vertex, next_hit, passed, cotangents, self._tables, landed
            )
        for name, found, like in input_cotangents.of_rays(vertex.state, attached=self.plan.attached):
            self._ray_cotangents[name].index_copy_(-1, lane, torch.zeros_like(like) if found is None else found)
        self.sums.add_each(input_cotangents.extra_leaves)
        if chance_cotangent is not None and input_cotangents.chance is not None:
            chance_cotangent.index_add_(0, index, input_cotangents.chance)

    def _light(self, ends: Ends, depth: int, state: PathState, hit: Hit, chance_cotangent: Tensor | None) -> None:
        """Pull cotangents back through emission, and add to those of the bounce in the same lanes."""
        table, integrator = self.world.lights, self.wave.integrator
        if table is None:
            return
        self._gathered(integrator.emit, ends.emissive, depth, state, hit, chance_cotangent)
        if table.environment is not None:
            self._gathered(integrator.escape, escaped(self.wave, state, ends), depth, state, hit, chance_cotangent)

    def _gathered(
        self,
        stage: Callable[[StageContext, VertexInput], Emission],
        index: Tensor,
        depth: int,
        state: PathState,
        hit: Hit,
        chance_cotangent: Tensor | None,
    ) -> None:
        if not len(index):
            return
        lane = take(state.lane, index)
        vertex = VertexInput(rows(state, index), rows(hit, index))
        with recording_gathers(self.sums):
            input_cotangents = adjoint.emission_vjp(
                stage, self._at(depth, lane), vertex, take(self._radiance_cotangent, lane), self._tables
            )
        for name, found, _ in input_cotangents.of_rays(vertex.state, attached=self.plan.attached):
            if found is not None:
                cotangents = self._ray_cotangents[name]
                cotangents.index_copy_(-1, lane, take(cotangents, lane) + found)
        self.sums.add_each(input_cotangents.extra_leaves)
        if chance_cotangent is not None and input_cotangents.chance is not None:
            chance_cotangent.index_add_(0, index, input_cotangents.chance)

    def vjp_rays(self) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        if not self.plan.attached:
            return
        with torch.enable_grad(), recording_gathers(self.sums):
            state = self.taped.rays(*self._span)
            pairs = [(x, self._ray_cotangents[name]) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if pairs:
                rays, cotangents = [x for x, _ in pairs], [g for _, g in pairs]
                self.sums.add_each(torch.autograd.grad(rays, self.tape.tables, cotangents, allow_unused=True))

    def _tables(self) -> Sequence[Tensor]:
        return self.tape.tables
