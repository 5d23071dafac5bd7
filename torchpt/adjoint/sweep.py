"""A chunk of lanes traced again and gone back along by kernels, in one thread and in memory of its own.

The kernels of the forward pass trace it, in an arena for each vertex; those of :mod:`torchpt.integrators.loop.joint` go back,
from the last arena to the first. Paths of more vertices than there are arenas are traced again in parts, from marks on the way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchpt.adjoint.assembly import Assembly
from torchpt.adjoint.samples import asked_of
from torchpt.adjoint.sums import ChunkSums, Sums
from torchpt.integrators import joint
from torchpt.integrators.joint import Before, Behind
from torchpt.integrators.loop.chunk import Chunk, Worker
from torchpt.integrators.loop.joint_kernels import JointKernels
from torchpt.integrators.loop.kernels import Kernel
from torchpt.integrators.loop.rows import HIT, Memory
from torchpt.integrators.path import ENDLESS, slides
from torchpt.integrators.tally import Tally
from torchpt.math.gathers import gathered_by
from torchpt.records import Hit, PathState, Shadow
from torchpt.samplers import salts
from torchpt.settings import Settings

__all__ = ["Sweep"]

#: Vertices that are kept at once, and marks beyond them.
KEPT, MARKS = 16, 8
_STATE = ("o", "d", "t_max", "throughput", "radiance", "pdf", "lane", "key", "eta", "p", "n")


@dataclass
class Level:
    """The arena of a vertex, its lists of lanes, and how many are in them."""

    arena: Memory
    lists: list[Memory]
    depth: int = 0
    count: int = 0
    groups: Sequence[int] = ()
    places: Sequence[int] = ()


@dataclass(frozen=True)
class Mark:
    """The arena of a vertex as it was before lanes were listed."""

    depth: int
    words: np.ndarray | None  # None: camera rays


class Sweep(Worker):
    """What one thread needs to go back along chunks.

    Args:
        kernels: of the backward pass.
        assembly: what waves read.
        settings: of the backward pass.
    """

    def __init__(self, kernels: JointKernels, assembly: Assembly, settings: Settings) -> None:
        super().__init__(kernels)
        self.joint, self.assembly, self.settings = kernels, assembly, settings
        self._levels: list[Level] = []
        self._behind = Memory(kernels.slots.count)
        self._results = Memory(1)
        self._spare = [self._level() for _ in range(2)]
        self._kept: list[Level] = []

    def _level(self) -> Level:
        kernels = self.kernels
        return Level(Memory(kernels.state.count), [Memory(1) for _ in range(kernels.models + 2)])

    def run(self, chunk: Chunk, pixels: Tensor, whole: Sums | None) -> ChunkSums:
        """Derivatives of a chunk, of what is asked of its pixels ``(3, n)``; ``whole``: see :class:`ChunkSums`."""
        self.start(chunk)
        self.sums = ChunkSums((*self.assembly.leaves, *self.assembly.held), whole)
        n = chunk.pixels * chunk.samples
        self._chunk = chunk
        marks = self._forward(Mark(1, None), None)
        radiance = torch.from_numpy(self.slots.floats[:, :n])
        asked = asked_of(self.settings, radiance.reshape(3, chunk.samples, -1), pixels).reshape(3, -1)
        if self._weight is not None:
            asked = asked * self._weight
        first = self.joint.slots.first
        self._behind.words[:, :n] = 0
        self._behind.floats[first("radiance") : first("radiance") + 3, :n] = asked.numpy()
        self._back(marks, None)
        if self.joint.joint_plan.attached:
            self._camera(n)
        return self.sums

    # -- forward

    def _forward(self, mark: Mark, end: int | None) -> list[Mark]:
        """Trace paths from a mark to vertex ``end``, all arenas kept; where there are too many, marks on the way instead."""
        kernels, calls, chunk = self.kernels, self.calls, self._chunk
        limits = self.wave.limits
        assert limits is not None
        self._kept, marks, step = [], [], KEPT
        level, depth = self._next(0), mark.depth
        shadow = False
        if mark.words is None:
            count = chunk.pixels * chunk.samples
            calls.name_salts(0)
            self._generate(chunk, level.arena, self._spare[1].arena)
            self._weight = None
            if "weight" in kernels.state:
                row = kernels.state.first("weight")
                self._weight = torch.from_numpy(level.arena.floats[row, :count].copy())
        else:
            count = mark.words.shape[1]
            level.arena.words[:, :count] = mark.words
        fresh = mark.words is None
        while count and depth != end:
            if fresh:
                self.search.nearest(level.arena, count, depth)
            if (depth - mark.depth) % step == 0 and depth > mark.depth:
                marks = marks or [mark]
                marks.append(Mark(depth, level.arena.words[:, :count].copy()))
                if len(marks) > MARKS:
                    marks, step = marks[::2], 2 * step
            calls.clear()
            calls.run(kernels.settle(shadow), count, level.arena, level.arena, lists=level.lists)
            groups, places = self._listed()
            level.depth, level.count, level.groups, level.places = depth, count, list(groups), list(places)
            if not marks:
                self._kept.append(level)
            if not self._met_light(level.arena, level.lists, level.groups, level.places, depth, Tally()):
                break
            following = self._next(depth + 1 - mark.depth)
            calls.clear()
            self._bounce(level.arena, following.arena, level.lists, following.lists, level.groups, depth)
            count = sum(level.groups)
            shadow = "shadow_o" in kernels.state
            if shadow:
                self.search.light(following.arena, count)
            level, depth, fresh = following, depth + 1, True
        return marks

    def _next(self, number: int) -> Level:
        """The memory of a vertex; of those behind the kept ones two take turns."""
        if number >= KEPT:
            return self._spare[number % 2]
        if number == len(self._levels):
            self._levels.append(self._level())
        return self._levels[number]

    # -- back

    def _back(self, marks: list[Mark], end: int | None) -> None:
        """Back along what was kept, or from mark to mark."""
        if not marks:
            for level in reversed(self._kept):
                self._vertex(level)
        for k in reversed(range(len(marks))):
            until = marks[k + 1].depth if k + 1 < len(marks) else end
            self._back(self._forward(marks[k], until), until)

    def _vertex(self, level: Level) -> None:
        kernels, calls, depth = self.joint, self.calls, level.depth
        limits = self.wave.limits
        assert limits is not None
        slide = slides(kernels.joint_plan, kernels.world, depth)
        calls.name_salts(depth)
        last = limits.max_depth if limits.max_depth >= 0 else ENDLESS
        if depth < last:
            for model, count in enumerate(level.groups):
                if count:
                    key = ("bounce", model, limits.roulette(depth), slide)
                    self._one(key, level, level.lists[model], count, False)
        if kernels.has_emitters and level.places[kernels.emissive]:
            place = kernels.emissive
            self._one(("emit", slide), level, level.lists[place], level.places[place], True)
        if kernels.has_environment and level.places[kernels.missed]:
            place = kernels.missed
            self._one(("escape",), level, level.lists[place], level.places[place], True)
        if depth > 1:
            calls.run(kernels.report(), level.count, level.arena, level.arena, slots=self._behind)

    def _one(self, key: tuple, level: Level, places: Memory, count: int, added: bool) -> None:
        """Back through one stage on the lanes of a list, by its kernel or by tensor operations."""
        kernel = self.joint.back_kernel(key)
        if kernel is None:
            self._eagerly(key, level, places, count, added)
            return
        self._results = self._room(kernel)
        self.calls.run(kernel, count, level.arena, self._results, places, slots=self._behind)
        floats, words = self._results.floats, self._results.words
        for number, index, first, width in kernel.program.sums:
            values = floats[first : first + width, :count]
            if index < 0:
                self.sums.add_all(number, values)
            else:
                self.sums.add_rows(number, words[index, :count], values)

    def _room(self, kernel: Kernel) -> Memory:
        rows = max((max(index + 1, first + width) for _, index, first, width in kernel.program.sums), default=1)
        return self._results if len(self._results.words) >= rows else Memory(rows)

    def _eagerly(self, key: tuple, level: Level, places: Memory, count: int, added: bool) -> None:
        """Back through a stage by tensor operations, for what no kernel can be made of."""
        kernels, plan = self.joint, self.joint.joint_plan
        lanes = places.words[0, :count]
        given = kernels.state.take(level.arena, lanes, _STATE)
        state = PathState(**{"eta": None, "p": None, "n": None, **given})  # type: ignore[arg-type]
        hit = Hit(**kernels.state.take(level.arena, lanes, tuple(HIT)))
        lane = state.lane.numpy()
        rows = kernels.slots.take(self._behind, lane, tuple(joint_names(plan.attached)))

        def clear(_: Shadow) -> Tensor:
            return rows["clear"]

        before: Before
        with gathered_by(self.sums):
            if key[0] == "bounce":
                behind = Behind(rows["radiance"], rows["throughput"], rows.get("o"), rows.get("d"))
                following = Hit(*(rows[name] for name in HIT)) if plan.attached else None
                before = joint.bounce(
                    plan, kernels.taped, key[1], key[2], key[3], following, clear, state, hit, behind,
                    salts(level.depth, torch.device("cpu")), kernels.taped_pixel, self._tensors,
                )  # fmt: skip
            elif key[0] == "emit":
                before = joint.emit(plan, kernels.taped, key[1], state, hit, rows["radiance"], self._tensors)
            else:
                before = joint.escape(plan, kernels.taped, state, hit, rows["radiance"], self._tensors)
        for name in ("throughput", "o", "d") if plan.attached else ("throughput",):
            found, first = getattr(before, name), kernels.slots.first(name)
            found = np.zeros((3, count), np.float32) if found is None else found.numpy()
            held = self._behind.floats[first : first + 3]
            held[:, lane] = found + held[:, lane] if added else found
        self.sums.add_each(before.others)

    def _tensors(self) -> Sequence[Tensor]:
        return (*self.assembly.leaves, *self.assembly.held)

    def _camera(self, n: int) -> None:
        """Back through the camera rays, by tensor operations."""
        chunk, first = self._chunk, self.joint.slots.first
        with torch.enable_grad(), gathered_by(self.sums):
            state = self.assembly.taped.rays(chunk.first_pixel, chunk.pixels, chunk.first_sample, chunk.samples)
            pairs = [(x, first(name)) for name, x in (("o", state.o), ("d", state.d)) if x.requires_grad]
            if not pairs:
                return
            asked = [torch.from_numpy(self._behind.floats[row : row + 3, :n].copy()) for _, row in pairs]
            found = torch.autograd.grad([x for x, _ in pairs], self._tensors(), asked, allow_unused=True)
        self.sums.add_each(found)


def joint_names(attached: bool) -> Sequence[str]:
    """Fields of the slots that are read."""
    return (*joint_fields, *HIT) if attached else ("radiance", "throughput", "clear")


joint_fields = ("radiance", "throughput", "o", "d", "clear")
