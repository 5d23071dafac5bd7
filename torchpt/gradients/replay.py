"""Paths are traced again from their random numbers, without a tape, and then gone back along vertex by vertex.

Of a chunk of lanes the states at its vertices are kept, some 120 bytes a lane each; a vertex is differentiated alone
(:mod:`torchpt.paths.adjoint`), from the last one to the first. What is handed from vertex to vertex lies by lanes: each
path has one, and reads there what those behind it ask of the ray that left. Paths of many vertices are traced again in parts,
from marks on the way, so that memory does not grow with depth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchpt.core.memory import Budget, Span
from torchpt.engines.tensors import Paths, Tensors, escaped
from torchpt.gradients.parameters import SceneTape
from torchpt.gradients.sums import Sums
from torchpt.gradients.tape import sample_cotangents
from torchpt.math.gathers import recording_gathers
from torchpt.math.vectors import rows, take
from torchpt.paths import adjoint
from torchpt.paths.adjoint import VertexCotangents
from torchpt.paths.integrators.path import Ends, follows_shape, partition
from torchpt.paths.state import EXTRA, PathState, Shadow, Splat, VertexInput
from torchpt.paths.walk import Observer, walk
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene.settings import Settings

__all__ = ["replay"]

#: Lanes of a chunk. Always the same: sums of other chunks would be rounded otherwise.
LANES = {"cpu": 1 << 16, "cuda": 1 << 20}
#: Vertices that are kept at once, and marks beyond them.
KEPT, MARKS = 24, 8


@dataclass
class Vertex:
    """The paths of a chunk at a vertex, and how much of the light of their shadow rays got through, group by group."""

    depth: int
    state: PathState
    hit: Hit
    clear: list[Tensor] = field(default_factory=list)
    splat_clear: list[Tensor] = field(default_factory=list)


class Keeper(Observer[Paths]):
    """Keeps the vertices of a walk: the first ones all, of those behind some as marks."""

    def __init__(self) -> None:
        self.kept: list[Vertex] = []
        self.marks: list[Vertex] = []
        self._step = KEPT
        self._now: Vertex | None = None

    def left(self, paths: Paths) -> None:
        """See :class:`Observer`."""
        assert self._now is not None
        self._now.clear, self._now.splat_clear = paths.clear, paths.splat_clear

    def arrived(self, paths: Paths) -> bool:
        """See :class:`Observer`."""
        self._now = Vertex(paths.depth, paths.state, paths.met)
        if len(self.kept) < KEPT:
            self.kept.append(self._now)
        elif (paths.depth - self.kept[-1].depth - 1) % self._step == 0:
            self.marks.append(self._now)
            if len(self.marks) > MARKS:
                self.marks = self.marks[::2]
                self._step *= 2
        return False


def replay(assembly: SceneTape, settings: Settings, cotangent: Tensor, sums: Sums) -> None:
    """Reverse mode by replaying paths; as :func:`torchpt.gradients.tape.tape`, but memory does not grow with depth.

    Chunks have fewer lanes only where an allocation failed.
    """
    wave = assembly.wave

    def whole(span: Span) -> None:
        sums.join(piece(assembly, settings, cotangent, span))

    device = wave.centre.device
    budget = Budget(device, LANES.get(device.type, LANES["cpu"]), what="the vertices of a single lane")
    assembly.through(budget, whole, wave.crop[2] * wave.crop[3], settings.render.spp)


def piece(assembly: SceneTape, settings: Settings, cotangent: Tensor, span: Span) -> Sums:
    """Return the sums of a chunk."""
    sums = assembly.sums()
    _Chunk(assembly, settings, span, sums).run(cotangent)
    return sums


class _Chunk:
    """A chunk of lanes.

    Args:
        assembly: what waves read.
        settings: of the backward pass.
        span: its samples.
        sums: what is added to.
    """

    def __init__(self, assembly: SceneTape, settings: Settings, span: Span, sums: Sums) -> None:
        self.assembly, self.settings, self.span, self.sums = assembly, settings, span, sums
        self.wave, self.taped = assembly.wave, assembly.taped
        self.plan = self.wave.context.plan
        self.world = self.taped.context.world
        self.tensors = [*assembly.leaves, *assembly.held]
        self.differentiates_opacity = assembly.differentiates_opacity
        self.engine = Tensors(replace(self.wave, context=self.taped.context), 0)

    def run(self, pixels: Tensor) -> None:
        """Add what a loss asks, by pixels of the picture ``(3, H W)``, to the sums."""
        if self.wave.integrator.splats:
            self.cotangent = pixels.to(self.plan.dtype) / self.settings.render.spp
        pixels = pixels[:, self.span[0] : self.span[0] + self.span[1]]
        with torch.no_grad():
            start = self.wave.rays(*self.span)
            radiance, keeper = self._trace(start, 1, None, None)
            samples = self.span[3]
            weight = self.wave.weight(start) if self.wave.filter.signed else None
            brought = radiance if weight is None else radiance * weight
            cotangent = sample_cotangents(
                self.settings, brought.view(3, samples, -1), pixels.to(radiance.dtype)
            ).reshape(3, -1)
            # What the rest of its path asks of each lane's ray, and what that ray met.
            self.radiance = cotangent if weight is None else cotangent * weight
            self.behind = {name: torch.zeros_like(cotangent) for name in ("throughput", "o", "d")[: self._rows]}
            n = cotangent.shape[1]
            for own in self.wave.integrator.fields:
                if not own.whole:
                    self.behind[EXTRA + own.name] = torch.zeros_like(own.begin(cotangent[0]))
            zero = torch.zeros(n, dtype=cotangent.dtype, device=cotangent.device)
            self.met = Hit(zero.clone(), torch.full_like(start.lane, -1), zero.clone(), zero.clone())
            self._back(keeper)
        self._camera(start)

    @property
    def _rows(self) -> int:
        return 3 if self.plan.attached else 1

    # -- forward

    def _trace(self, state: PathState, depth: int, hit: Hit | None, end: int | None) -> tuple[Tensor, Keeper]:
        keeper, engine = Keeper(), Tensors(self.wave, self.span[1] * self.span[3])
        paths = engine.spawn(state) if depth == 1 else Paths(state, depth, hit)
        walk(engine, paths, self.wave.integrator.limits, keeper, end)
        return engine.brought(), keeper

    # -- back

    def _back(self, keeper: Keeper, end: int | None = None) -> None:
        """Back from vertex ``end`` (None: from the last)."""
        marks = keeper.marks
        for k in reversed(range(len(marks))):
            mark, until = marks[k], marks[k + 1].depth if k + 1 < len(marks) else end
            state = replace(mark.state, radiance=torch.zeros_like(mark.state.radiance))
            _, part = self._trace(state, mark.depth, mark.hit, until)
            self._back(part, until)
        for vertex in reversed(keeper.kept):
            self._vertex(vertex)

    def _vertex(self, vertex: Vertex) -> None:
        """Back through a vertex: its lanes came grouped by the models before it, and are taken in the order of samples."""
        depth, order = vertex.depth, vertex.state.lane.argsort()
        place = torch.empty_like(order).index_copy_(0, order, torch.arange(len(order), device=order.device))
        state, hit = rows(vertex.state, order), rows(vertex.hit, order)
        follow_shape = follows_shape(self.plan, self.world, depth)
        ends, groups = partition(self.world, vertex.hit)
        ends = Ends(take(place, ends.emissive).msort(), take(place, ends.missed).msort())
        chance, cotangent = self._chance(state, depth)
        hit = replace(hit, chance=chance)
        limits = self.wave.integrator.limits
        clear, splat_clear = iter(vertex.clear), iter(vertex.splat_clear)
        if depth < limits.last:
            for model, came in groups:
                index, turn = take(place, came).sort()
                self._bounce(model, depth, follow_shape, clear, splat_clear, turn, state, hit, index, cotangent)
        self._light(ends, depth, follow_shape, state, hit, cotangent)
        if chance is not None and cotangent is not None:
            found = torch.autograd.grad(chance, self.tensors, cotangent, allow_unused=True)
            self.sums.add_each(found)
        if self.plan.attached:
            for name in ("t", "prim", "u", "v"):
                getattr(self.met, name).index_copy_(0, state.lane, getattr(hit, name))

    def _chance(self, state: PathState, depth: int) -> tuple[Tensor | None, Tensor | None]:
        """The chance to get here under a tape, where it has derivatives, and zeros for what is asked of it."""
        if not self.differentiates_opacity:
            return None, None
        with torch.enable_grad(), recording_gathers(self.sums):
            chance = self.engine.hits(state, depth).chance
        if chance is None or not chance.requires_grad:
            return None, None
        return chance, torch.zeros_like(chance)

    def _bounce(
        self,
        model: int,
        depth: int,
        follow_shape: bool,
        clear: Iterator[Tensor],
        splat_clear: Iterator[Tensor],
        turn: Tensor,
        state: PathState,
        hit: Hit,
        index: Tensor,
        cotangent: Tensor | None,
    ) -> None:
        lane = take(state.lane, index)
        next_hit = rows(self.met, lane) if self.plan.attached else None
        behind = VertexCotangents(
            take(self.radiance, lane),
            take(self.behind["throughput"], lane),
            *(take(self.behind[name], lane) if self.plan.attached else None for name in ("o", "d")),
            extra={k.removeprefix(EXTRA): take(x, lane) for k, x in self.behind.items() if k.startswith(EXTRA)},
        )

        def passed(shadow: Shadow) -> Tensor:
            kept = next(clear)
            return self.engine.clear(shadow) if self.differentiates_opacity else take(kept, turn)

        def landed(splat: Splat) -> tuple[Tensor, Tensor]:
            kept = next(splat_clear)
            through = self.engine.clear(splat.light) if self.differentiates_opacity else take(kept, turn)
            return adjoint.splatted(self.settings.integrator.clamp, self.cotangent, splat, through)

        limits = self.wave.integrator.limits
        with recording_gathers(self.sums):
            context = self.taped.context.at(salts(depth, lane.device), follow_shape, limits.roulette(depth))
            vertex = VertexInput(rows(state, index), rows(hit, index))
            stage = self.wave.integrator.bounce
            before = adjoint.bounce(stage, context, model, vertex, next_hit, passed, behind, self._others, landed)
        for name, found, like in before.of_rays(vertex.state, self.plan.attached):
            self.behind[name].index_copy_(-1, lane, torch.zeros_like(like) if found is None else found)
        self.sums.add_each(before.others)
        if cotangent is not None and before.chance is not None:
            cotangent.index_add_(0, index, before.chance)

    def _light(
        self, ends: Ends, depth: int, follow_shape: bool, state: PathState, hit: Hit, cotangent: Tensor | None
    ) -> None:
        """Back through light that was met by chance; what a bounce asks of the same lanes is there already."""
        table = self.world.lights
        if table is None:
            return
        for index, here in ((ends.emissive, True), (escaped(self.wave, state, ends), False)):
            if not len(index) or (not here and table.environment is None):
                continue
            lane = take(state.lane, index)
            vertex = VertexInput(rows(state, index), rows(hit, index))
            integrator = self.wave.integrator
            context = self.taped.context.at(salts(depth, lane.device), follow_shape)
            stage = integrator.emit if here else integrator.escape
            with recording_gathers(self.sums):
                before = adjoint.gather(stage, context, vertex, take(self.radiance, lane), self._others)
            for name, found, _ in before.of_rays(vertex.state, self.plan.attached):
                if found is not None:
                    behind = self.behind[name]
                    behind.index_copy_(-1, lane, take(behind, lane) + found)
            self.sums.add_each(before.others)
            if cotangent is not None and before.chance is not None:
                cotangent.index_add_(0, index, before.chance)

    def _camera(self, start: PathState) -> None:
        """Back through the camera rays."""
        if not self.plan.attached:
            return
        with torch.enable_grad(), recording_gathers(self.sums):
            state = self.taped.rays(*self.span)
            pairs = [(x, self.behind[name]) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if pairs:
                found = torch.autograd.grad(
                    [x for x, _ in pairs], self.tensors, [g for _, g in pairs], allow_unused=True
                )
                self.sums.add_each(found)

    def _others(self) -> Sequence[Tensor]:
        return self.tensors
