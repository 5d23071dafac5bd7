"""A chunk of lanes traced again and gone back along by kernels, in one thread and in memory of its own.

The kernels of the forward pass trace it, in an arena for each vertex; those of :mod:`torchpt.engines.kernels.backward` go back,
from the last arena to the first. Paths of more vertices than there are arenas are traced again in parts, from marks on the way.

Lanes lie in an arena as they come; stages are gone back through in the order of samples, as :mod:`torchpt.gradients.sums` asks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.form import CAPACITY
from torchpt.engines.kernels.backward import VjpKernels, slots_read
from torchpt.engines.kernels.engine import Chunk, Paths, Worker
from torchpt.engines.kernels.layout import HIT, Memory, path_state
from torchpt.engines.kernels.programs import Kernel
from torchpt.gradients.parameters import SceneTape
from torchpt.gradients.sums import ChunkSums, Sums
from torchpt.gradients.tape import sample_cotangents
from torchpt.math.gathers import recording_gathers
from torchpt.paths import adjoint
from torchpt.paths.adjoint import Before, VertexCotangents
from torchpt.paths.integrators.path import follows_shape
from torchpt.paths.state import EXTRA, Shadow, Splat, VertexInput
from torchpt.paths.walk import Counts, Observer, walk
from torchpt.physics.samplers import salts
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene.settings import Settings

__all__ = ["Sweep"]

#: Vertices that are kept at once, and marks beyond them.
KEPT, MARKS = 16, 8


@dataclass(frozen=True)
class Mark:
    """The arena of a vertex as it was before lanes were listed."""

    depth: int
    words: np.ndarray | None  # None: camera rays


class Keeper(Observer[Paths]):
    """Keeps the vertices of a walk; where they are too many, marks on the way instead.

    Args:
        mark: where the walk begins.
    """

    def __init__(self, mark: Mark) -> None:
        self.kept: list[Paths] = []
        self.marks: list[Mark] = []
        self._first, self._step = mark, KEPT

    def arrived(self, paths: Paths) -> bool:
        """See :class:`Observer`."""
        past = paths.depth - self._first.depth
        if past > 0 and past % self._step == 0:
            self.marks = self.marks or [self._first]
            self.marks.append(Mark(paths.depth, paths.arena.words[:, : paths.count].copy()))
            if len(self.marks) > MARKS:
                self.marks, self._step = self.marks[::2], 2 * self._step
        return False

    def sorted(self, paths: Paths, counts: Counts) -> bool:
        """See :class:`Observer`."""
        if not self.marks:
            self.kept.append(paths)
        return False


class Sweep(Worker):
    """The engine of one thread that goes back along chunks.

    Args:
        kernels: of the backward pass.
        assembly: what waves read.
        settings: of the backward pass.
    """

    keeps_splats = False  # it goes back along their vertices

    def __init__(self, kernels: VjpKernels, assembly: SceneTape, settings: Settings) -> None:
        super().__init__(kernels)
        self.joint, self.assembly, self.settings = kernels, assembly, settings
        self._levels: list[Paths] = []
        self._behind = Memory(kernels.slots.count)
        self._results = Memory(1)
        self._sorted = Memory(2), np.zeros(CAPACITY, np.uint8)  # slots of a list's lanes, and what sorting takes
        self._start = 1

    def run(self, chunk: Chunk, pixels: Tensor, whole: Sums | None) -> ChunkSums:
        """Return the derivatives of a chunk, of what is asked of its pixels ``(3, n)``; ``whole``: see :class:`ChunkSums`."""
        self.sums = ChunkSums((*self.assembly.leaves, *self.assembly.held), whole)
        n = chunk.pixels * chunk.samples
        self._chunk = chunk
        keeper = self._forward(Mark(1, None), None)
        radiance = torch.from_numpy(self.slots.floats[:, :n])
        asked = sample_cotangents(self.settings, radiance.reshape(3, chunk.samples, -1), pixels).reshape(3, -1)
        if self._weight is not None:
            asked = asked * self._weight
        first = self.joint.slots.first
        self._behind.words[:, :n] = 0
        self._behind.floats[first("radiance") : first("radiance") + 3, :n] = asked.numpy()
        self._back(keeper, None)
        if self.joint.taped.plan.attached:
            self._camera(n)
        return self.sums

    # -- forward

    def room(self, depth: int) -> Paths:
        """See :class:`Worker`: the first vertices of a part are all kept, of those behind two take turns."""
        number = depth - self._start
        if number >= KEPT:
            return self._rooms[number % 2]
        if number == len(self._levels):
            self._levels.append(self._room())
        return self._levels[number]

    def _forward(self, mark: Mark, end: int | None) -> Keeper:
        """Trace paths from a mark to vertex ``end``."""
        self._start, keeper = mark.depth, Keeper(mark)
        if mark.words is None:
            paths = self.spawn(self._chunk)
            self._weight = None
            if "weight" in self.kernels.state:
                row = self.kernels.state.first("weight")
                self._weight = torch.from_numpy(paths.arena.floats[row, : paths.count].copy())
        else:
            count = mark.words.shape[1]
            paths = self._begin(self.room(mark.depth), mark.depth, count)
            paths.arena.words[:, :count] = mark.words
            paths.arrived = True
        walk(self, paths, self.wave.integrator.limits, keeper, end)
        self.mark_lost()
        return keeper

    # -- back

    def _back(self, keeper: Keeper, end: int | None) -> None:
        """Back along what was kept, or from mark to mark."""
        marks = keeper.marks
        if not marks:
            for paths in reversed(keeper.kept):
                self._vertex(paths)
        for k in reversed(range(len(marks))):
            until = marks[k + 1].depth if k + 1 < len(marks) else end
            self._back(self._forward(marks[k], until), until)

    def _vertex(self, paths: Paths) -> None:
        kernels, calls, depth = self.joint, self.calls, paths.depth
        limits = self.wave.integrator.limits
        follow_shape = follows_shape(kernels.taped.plan, kernels.world, depth)
        calls.set_dimensions(depth)
        if depth < limits.last:
            for model, count in enumerate(paths.groups):
                if count:
                    key = ("bounce", model, limits.roulette(depth), follow_shape)
                    self._one(key, paths, paths.lists[model], count, False)
        if kernels.has_emitters and paths.places[kernels.emissive]:
            place = kernels.emissive
            self._one(("emit", follow_shape), paths, paths.lists[place], paths.places[place], True)
        if kernels.has_environment and paths.places[kernels.missed]:
            place = kernels.missed
            self._one(("escape",), paths, paths.lists[place], paths.places[place], True)
        if depth > 1:
            calls.run(kernels.report(), paths.count, paths.arena, paths.arena, slots=self._behind)

    def _one(self, key: tuple, paths: Paths, places: Memory, count: int, added: bool) -> None:
        """Back through one stage on the lanes of a list, by its kernel or by tensor operations."""
        kernel = self.joint.vjp_kernel(key)
        slots = self._by_sample(paths, places, count) if kernel is None or kernel.program.sums else None
        if kernel is None:
            self._eagerly(key, paths, places, count, added)
            return
        self._results = self._results_of(kernel)
        self.calls.run(kernel, count, paths.arena, self._results, places, slots=self._behind)
        if slots is None:
            return
        floats, words = self._results.floats, self._results.words
        for number, index, first, width in kernel.program.sums:
            values = floats[first : first + width, :count]
            if index < 0:
                self.sums.add_all(number, values, slots)
            else:
                self.sums.add_rows(number, words[index, :count], values, slots)

    def _by_sample(self, paths: Paths, places: Memory, count: int) -> np.ndarray:
        """Sort the lanes of a list by their samples; return the slots of these, rising."""
        from torchpt.gradients.kernels import sort_by_sample

        lanes, (memory, taken) = paths.arena.words[self.joint.state.first("lane")], self._sorted
        slots, found = memory.words
        sort_by_sample(places.words[0], count, lanes, slots, found, taken)
        return slots[:count]

    def _results_of(self, kernel: Kernel) -> Memory:
        rows = max((max(index + 1, first + width) for _, index, first, width in kernel.program.sums), default=1)
        return self._results if len(self._results.words) >= rows else Memory(rows)

    def _eagerly(self, key: tuple, paths: Paths, places: Memory, count: int, added: bool) -> None:
        """Back through a stage by tensor operations, for what no kernel can be made of."""
        kernels, integrator, salt = self.joint, self.wave.integrator, salts(paths.depth, torch.device("cpu"))
        plan = kernels.taped.plan
        lanes = places.words[0, :count]
        state = path_state(kernels.state.take(paths.arena, lanes, kernels.state.state))
        vertex = VertexInput(state, Hit(**kernels.state.take(paths.arena, lanes, tuple(HIT))))
        lane = state.lane.numpy()
        rows = kernels.slots.take(self._behind, lane, slots_read(kernels))

        def clear(_: Shadow) -> Tensor:
            return rows["clear"]

        def landed(splat: Splat) -> tuple[Tensor, Tensor]:
            assert kernels.cotangent is not None
            return adjoint.splatted(integrator.clamp, kernels.cotangent, splat, rows["splat_clear"])

        before: Before
        with recording_gathers(self.sums):
            if key[0] == "bounce":
                extra = {name.removeprefix(EXTRA): value for name, value in rows.items() if name.startswith(EXTRA)}
                behind = VertexCotangents(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"), extra)
                next_hit = Hit(*(rows[name] for name in HIT)) if plan.attached else None
                _, model, roulette, follow_shape = key
                context = kernels.taped.at(salt, follow_shape, roulette)
                before = adjoint.bounce(
                    integrator.bounce, context, model, vertex, next_hit, clear, behind, self._tensors, landed
                )
            else:
                stage = integrator.emit if key[0] == "emit" else integrator.escape
                before = adjoint.gather(
                    stage, kernels.taped.at(salt, *key[1:]), vertex, rows["radiance"], self._tensors
                )
        for name, found, like in before.of_rays(state, plan.attached):
            first = kernels.slots.first(name)
            values = np.zeros(like.shape, np.float32) if found is None else found.numpy()
            values = values.reshape(-1, count)
            held = self._behind.floats[first : first + len(values)]
            held[:, lane] = values + held[:, lane] if added else values
        self.sums.add_each(before.others)

    def _tensors(self) -> Sequence[Tensor]:
        return (*self.assembly.leaves, *self.assembly.held)

    def _camera(self, n: int) -> None:
        """Back through the camera rays, by tensor operations."""
        chunk, first = self._chunk, self.joint.slots.first
        with torch.enable_grad(), recording_gathers(self.sums):
            state = self.assembly.taped.rays(chunk.first_pixel, chunk.pixels, chunk.first_sample, chunk.samples)
            pairs = [(x, first(name)) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if not pairs:
                return
            asked = [torch.from_numpy(self._behind.floats[row : row + 3, :n].copy()) for _, row in pairs]
            found = torch.autograd.grad([x for x, _ in pairs], self._tensors(), asked, allow_unused=True)
        self.sums.add_each(found)
