"""The backward engine of tensor operations: for CUDA, float64, and stages that cannot be compiled.

Path replay (:mod:`torchpt.gradients.replay`) traces the paths of a chunk by :func:`torchpt.paths.walk.walk`, keeps the
population of each vertex, and then calls :meth:`TensorsBackward.vjp` for each vertex from the last one to the first. Cotangents
between vertices are stored by sample: the VJP of a vertex reads the cotangents of the rays that left it, and writes those of
the rays that came.

*Taped* values carry autograd leaves (:class:`torchpt.paths.adjoint.Tape`); all others are computed without derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.core.autograd import gradients_of
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
        super().__init__(tape.wave, lanes=0)  # `begin` sets the number of samples of a chunk
        self.tape, self.taped, self._cotangent = tape, tape.taped, cotangent
        # Traces rays through differentiated opacity on a tape.
        self._taped_engine = TensorsEngine(replace(tape.wave, context=tape.taped.context), lanes=0)
        # fields of a ray that have cotangents: origin and direction only if geometry is differentiated
        self._differentiated_fields = ("throughput", "o", "d") if self.plan.attached else ("throughput",)

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
        radiance = self.path_radiance()
        return radiance if self._weight is None else radiance * self._weight

    def receive(self, cotangent: Tensor) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        # By sample: cotangents of the radiance and of the ray that leaves the vertex at hand, and the hit of that ray.
        self._radiance_cotangent = cotangent if self._weight is None else cotangent * self._weight
        self._ray_cotangents = {name: torch.zeros_like(cotangent) for name in self._differentiated_fields}
        for own_field in self.wave.integrator.fields:
            if not own_field.whole:  # whole numbers have no derivatives
                self._ray_cotangents[EXTRA + own_field.name] = torch.zeros_like(own_field.begin(cotangent[0]))
        zero = torch.zeros_like(cotangent[0])
        no_prim = torch.full(zero.shape, -1, dtype=torch.int64, device=zero.device)
        self._next_hit = Hit(zero.clone(), no_prim, zero.clone(), zero.clone())

    def vjp(self, paths: Paths) -> None:
        """See :class:`torchpt.engines.engine.Backward`. Lanes are sorted by sample, the order in which gradients are added."""
        depth, order = paths.depth, paths.state.lane.argsort()
        # the inverse permutation: from lanes of the population to sorted lanes
        sorted_lane = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=order.device))
        state, hit = rows(paths.state, order), rows(paths.hits, order)
        ends = Ends(take(sorted_lane, paths.ends.emissive).msort(), take(sorted_lane, paths.ends.missed).msort())
        chance, chance_cotangent, rays = self._chance(state, depth)
        hit = replace(hit, chance=chance)
        if depth < self.wave.integrator.limits.last:
            transmittance, splat_transmittance = (iter(kept) for kept in paths.passed)
            for model, lanes in paths.groups or ():
                index, permutation = take(sorted_lane, lanes).sort()
                self._bounce(
                    model, depth, transmittance, splat_transmittance, permutation, state, hit, index, chance_cotangent
                )
        self._light(ends, depth, state, hit, chance_cotangent)
        if chance is not None and chance_cotangent is not None:
            tables = self.tape.tables
            gradients = gradients_of([chance], [*tables, *rays.values()], [chance_cotangent])
            self.sums.add_each(gradients[: len(tables)])
            for name, gradient in zip(rays, gradients[len(tables) :], strict=True):
                if gradient is not None:
                    self._ray_cotangents[name].index_add_(-1, state.lane, gradient)
        if self.plan.attached:
            for name in ("t", "prim", "u", "v"):
                getattr(self._next_hit, name).index_copy_(0, state.lane, getattr(hit, name))

    def _chance(self, state: PathState, depth: int) -> tuple[Tensor | None, Tensor | None, dict[str, Tensor]]:
        """Return the probability factor of passed surfaces on a tape, with a zero cotangent to add to, and the rays.

        It is ``Hit.chance``, a factor of value 1 with the derivative of the probability that rays passed surfaces and stopped
        where they did. None: it has no derivative. The rays are leaves by the names of their fields; none where they do not
        move.
        """
        rays: dict[str, Tensor] = {}
        if not self.tape.differentiates_opacity:
            return None, None, rays
        if self.plan.attached:
            rays = {name: getattr(state, name).detach().requires_grad_() for name in ("o", "d")}
        with torch.enable_grad(), recording_gathers(self.sums):
            chance = self._taped_engine.hits(replace(state, **rays), depth).chance
        if chance is None or not chance.requires_grad:
            return None, None, {}
        return chance, torch.zeros_like(chance), rays

    def _taped_context(self, depth: int, device: torch.device, roulette: float = 0.0) -> StageContext:
        """Return the taped stage context of a vertex."""
        follow_ray = follows_ray(self.plan, self.taped.context.world, depth)
        return self.taped.context.at(salts(depth, device), follow_ray=follow_ray, roulette=roulette, depth=depth)

    def _bounce(
        self,
        model: int,
        depth: int,
        transmittance: Iterator[Tensor],
        splat_transmittance: Iterator[Tensor],
        permutation: Tensor,
        state: PathState,
        hit: Hit,
        index: Tensor,
        chance_cotangent: Tensor | None,
    ) -> None:
        """Pull cotangents back through the surfaces of a model.

        Args:
            model: index of the BSDF model.
            depth: number of the vertex.
            transmittance: yields that of the model's shadow rays ``(n,)``, in the order of its lanes in the population.
            splat_transmittance: yields that of its splats, likewise.
            permutation: ``(n,)``, from that order to the order of samples.
            state: all paths at the vertex, sorted by sample.
            hit: their hits.
            index: ``(n,)`` the lanes of the model among them, ascending.
            chance_cotangent: of the probability factor of all lanes, to add to; None: it has no derivative.
        """
        lane = take(state.lane, index)
        next_hit = rows(self._next_hit, lane) if self.plan.attached else None
        cotangents = VertexCotangents(
            take(self._radiance_cotangent, lane),
            take(self._ray_cotangents["throughput"], lane),
            *(take(self._ray_cotangents[name], lane) if self.plan.attached else None for name in ("o", "d")),
            extra={
                k.removeprefix(EXTRA): take(x, lane) for k, x in self._ray_cotangents.items() if k.startswith(EXTRA)
            },
        )

        def transmittance_of(shadow: Shadow, kept: Tensor) -> Tensor:
            """Return the transmittance of shadow rays: on a tape, or what the forward walk kept."""
            if self.tape.differentiates_opacity:
                return self._taped_engine.transmittance(shadow)
            return take(kept, permutation)

        def of_shadow(shadow: Shadow) -> Tensor:
            return transmittance_of(shadow, next(transmittance))

        def of_splat(splat: Splat) -> tuple[Tensor, Tensor]:
            arrived = transmittance_of(splat.light, next(splat_transmittance))
            assert self._cotangent is not None
            return adjoint.splat_contributions(self.wave.integrator.clamp, self._cotangent, splat, arrived)

        with recording_gathers(self.sums):
            roulette = self.wave.integrator.limits.roulette(depth)
            context = self._taped_context(depth, lane.device, roulette)
            vertex = VertexInput(rows(state, index), rows(hit, index))
            stage = self.wave.integrator.bounce
            input_cotangents = adjoint.bounce_vjp(
                stage, context, model, vertex, next_hit, of_shadow, cotangents, self._tables, of_splat
            )
        for name, value, like in input_cotangents.of_rays(vertex.state, attached=self.plan.attached):
            self._ray_cotangents[name].index_copy_(-1, lane, torch.zeros_like(like) if value is None else value)
        self.sums.add_each(input_cotangents.extra_leaves)
        if chance_cotangent is not None and input_cotangents.chance is not None:
            chance_cotangent.index_add_(0, index, input_cotangents.chance)

    def _light(self, ends: Ends, depth: int, state: PathState, hit: Hit, chance_cotangent: Tensor | None) -> None:
        """Pull cotangents back through emission, and add to those of the bounce in the same lanes."""
        table, integrator = self.world.lights, self.wave.integrator
        if table is None:
            return
        self._emission(integrator.emit, ends.emissive, depth, state, hit, chance_cotangent)
        if table.environment is not None:
            self._emission(integrator.escape, escaped(self.wave, state, ends), depth, state, hit, chance_cotangent)

    def _emission(
        self,
        stage: Callable[[StageContext, VertexInput], Emission],
        index: Tensor,
        depth: int,
        state: PathState,
        hit: Hit,
        chance_cotangent: Tensor | None,
    ) -> None:
        """Pull cotangents back through an emission stage at the lanes ``index``; other arguments as for :meth:`_bounce`."""
        if not len(index):
            return
        lane = take(state.lane, index)
        vertex = VertexInput(rows(state, index), rows(hit, index))
        with recording_gathers(self.sums):
            input_cotangents = adjoint.emission_vjp(
                stage,
                self._taped_context(depth, lane.device),
                vertex,
                take(self._radiance_cotangent, lane),
                self._tables,
            )
        for name, value, _ in input_cotangents.of_rays(vertex.state, attached=self.plan.attached):
            if value is not None:
                cotangents = self._ray_cotangents[name]
                cotangents.index_copy_(-1, lane, take(cotangents, lane) + value)
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
                rays, cotangents = [x for x, _ in pairs], [cotangent for _, cotangent in pairs]
                self.sums.add_each(gradients_of(rays, self.tape.tables, cotangents))

    def _tables(self) -> Sequence[Tensor]:
        """Return the differentiated tables, to which a VJP adds gradients."""
        return self.tape.tables
