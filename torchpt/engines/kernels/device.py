"""The engine of kernels on a CUDA device: launches all kernels of a wave without waiting for the device.

The stages are those of :mod:`~torchpt.engines.kernels.engine`; steps are run in another way. Each kernel reads the number of
its lanes from memory, where an earlier kernel has counted them, so steps are launched one after the other on torch's current
stream, also those that turn out to have no lanes. Counters are rows of a tensor; a new row is begun wherever threads of a CPU
set theirs to 0. Loops without a fixed end (paths without a depth limit, rays through surfaces) check every
:data:`CHECK_EVERY` steps whether lanes are left, and do so one check late, when the number is on the host.

Threads count in any order, so the places of lanes in an arena are random. No result depends on them: radiance is written to
the slot of its sample, and slots are added to the film in the order of samples.

Few primitives are searched inside stages, trees by kernels between them. Stages that cannot be compiled, and the search by a
tree of tensors where it is asked for, run as tensor operations between kernels; they wait for the number of lanes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.kernel import HEAD, WORD
from torchpt.engines.kernels.calls import Arguments, LaneCount
from torchpt.engines.kernels.device_kernels import KernelsOnDevice
from torchpt.engines.kernels.driver import Cuda, HostCopy
from torchpt.engines.kernels.engine import Chunk, KernelsEngine, Paths, film_words
from torchpt.engines.kernels.joins import Joins, TensorJoins
from torchpt.engines.kernels.layout import HIT, Block, Rows
from torchpt.engines.kernels.programs import Kernel
from torchpt.engines.kernels.searches import ChunkSearch
from torchpt.engines.kernels.stages import CHUNK_FIELDS
from torchpt.paths.walk import Counts, walk
from torchpt.paths.wave import RayCounts
from torchpt.physics.film import Film
from torchpt.physics.samplers import salts

__all__ = ["CHECK_EVERY", "Count", "DeviceCalls", "DeviceEngine", "DeviceMemory", "LateCheck"]

#: Steps between two checks of a loop without a fixed end for lanes that are left.
CHECK_EVERY = 4
#: Rows of counters that are allocated, and set to 0, at once.
_COUNTER_ROWS = 64


class DeviceMemory:
    """Rows of 32-bit words on a device; as :class:`torchpt.engines.kernels.layout.Memory`."""

    def __init__(self, rows: int, row: int, device: torch.device) -> None:
        self.words: Any = torch.zeros(rows, row, dtype=torch.int32, device=device)
        self.floats: Any = self.words.view(torch.float32)
        self.address: int = self.words.data_ptr()

    def repeat(self, first: int, values: Tensor, times: int) -> None:
        """See :meth:`torchpt.engines.kernels.layout.Memory.repeat`."""
        held = self.floats if values.is_floating_point() else self.words
        held[first : first + len(values), : times * values.shape[1]] = values.repeat(1, times)

    def take(self, first: int, rows: int, lanes: Tensor, dtype: torch.dtype) -> Tensor:
        """See :meth:`torchpt.engines.kernels.layout.Memory.take`."""
        held = self.floats if dtype.is_floating_point else self.words
        return held[first : first + rows].index_select(1, lanes).to(dtype)

    def put(self, first: int, start: int, values: Tensor) -> None:
        """See :meth:`torchpt.engines.kernels.layout.Memory.put`."""
        held = self.floats if values.is_floating_point() else self.words
        held[first : first + len(values), start : start + values.shape[1]] = values

    def scatter(self, first: int, lanes: Tensor, values: Tensor) -> None:
        """See :meth:`torchpt.engines.kernels.layout.Memory.scatter`."""
        held = self.floats if values.is_floating_point() else self.words
        held[first : first + len(values), lanes] = values.to(held.dtype)

    def below(self, row: int) -> Block:
        """See :meth:`torchpt.engines.kernels.layout.Memory.below`."""
        return Block(self.words[row:].data_ptr())


class Count:
    """A number of lanes in the device's memory; always true, as the host does not know it.

    Attributes:
        value: the number, a tensor of one element.
        address: of the number.
        counters: block, row and column of the counters that it is the sum of.
    """

    __slots__ = ("address", "counters", "value")

    def __init__(self, value: Tensor, counters: tuple[tuple[int, int, int], ...]) -> None:
        self.value, self.counters = value, counters
        self.address = value.data_ptr()


class LateCheck:
    """Checks whether a loop has lanes left, :data:`CHECK_EVERY` steps late.

    Args:
        cuda: the device.
    """

    def __init__(self, cuda: Cuda) -> None:
        self._cuda = cuda
        self._pending: HostCopy | None = None

    def ended(self, step: int, count: Count) -> bool:
        """Return True once no lanes were left at the check before; ``count``: lanes left at this step, counted from 0."""
        if step == 0:
            self._pending = None
        if step % CHECK_EVERY:
            return False
        if self._pending is not None and not int(self._pending.values()):
            return True
        self._pending = self._cuda.to_host(count.value)
        return False


class DeviceCalls:
    """Launches kernels on a device; as :class:`torchpt.engines.kernels.calls.Calls`.

    Args:
        kernels: of the render.

    Attributes:
        slots: radiance of the chunk's samples.
        blocks: tensors of counters of the wave, :data:`_COUNTER_ROWS` rows each.
    """

    def __init__(self, kernels: KernelsOnDevice) -> None:
        self.kernels, self.cuda = kernels, kernels.cuda
        self.device, self._row_length = kernels.cuda.device, kernels.row
        self.width = kernels.models + 6
        self.place = torch.zeros(len(CHUNK_FIELDS), dtype=torch.int32, device=self.device)
        self.slots = self.memory(3)
        self.blocks: list[Tensor] = []
        self._zero = Count(torch.zeros(1, dtype=torch.int64, device=self.device), ())
        self._row = _COUNTER_ROWS
        self._counters = 0
        self._max_lanes = 0  # lanes of the wave
        self._stream = 0
        self._look = LateCheck(self.cuda)
        self._prepared: dict[int, Arguments] = {}  # by id of the kernel, which they refer to
        self._salts: dict[tuple[int, int], Tensor] = {}
        self._bounds: dict[float, Tensor] = {}
        self._depths: dict[int, Tensor] = {}
        self._start_salts = self.cuda.to_device(salts(0, torch.device("cpu")))
        self._uniforms = {"place": self.place.data_ptr(), "start_salts": self._start_salts.data_ptr()}

    def memory(self, rows: int) -> Any:
        """Return new memory for kernels."""
        return DeviceMemory(rows, self._row_length, self.device)

    # -- counters

    def begin(self, lanes: int) -> None:
        """Begin a wave of ``lanes`` samples, with counters of its own."""
        self.blocks, self._row, self._max_lanes = [], _COUNTER_ROWS, lanes
        self.cuda.enter()
        self._stream = self.cuda.stream()

    def clear(self) -> None:
        """Go to the next row of counters, which are 0."""
        self._row += 1
        if self._row >= _COUNTER_ROWS:
            self.blocks.append(torch.zeros(_COUNTER_ROWS, self.width, dtype=torch.int64, device=self.device))
            self._row = 0
        self._counters = self.blocks[-1].data_ptr() + 8 * self.width * self._row

    def _count(self, column: int) -> Count:
        """Return a counter of the current row."""
        value = self.blocks[-1][self._row, column : column + 1]
        return Count(value, ((len(self.blocks) - 1, self._row, column),))

    def counted(self) -> tuple[Count, list[Count]]:
        """See :meth:`torchpt.engines.kernels.calls.Calls.counted`."""
        return self._count(0), [self._count(1 + k) for k in range(self.kernels.models + 2)]

    def lanes(self, count: int) -> Count:
        """Return a known number of lanes as a count."""
        self.clear()
        found = self._count(0)
        found.value.fill_(count)
        return found

    def left(self, step: int) -> LaneCount:
        """Return counter 0, or 0 once no rays were left at the check before."""
        count = self._count(0)
        return 0 if self._look.ended(step, count) else count

    def running_sums(self, counts: Sequence[Count]) -> tuple[list[Any], Any]:
        """See :meth:`torchpt.engines.kernels.calls.Calls.running_sums`; with the search in the stages nothing needs them."""
        if self.kernels.fused:
            return [None] * len(counts), None
        if len(counts) == 1:
            return [self._zero], counts[0]
        values = torch.cat([count.value for count in counts])
        sums = values.cumsum(0)
        starts, every = sums - values, sum((count.counters for count in counts), ())
        return [Count(starts[k : k + 1], ()) for k in range(len(counts))], Count(sums[-1:], every)

    def write_from(self, start: Count) -> None:
        """See :meth:`torchpt.engines.kernels.calls.Calls.write_from`: the kernel reads ``start`` as counter 0."""
        # The tensor may be freed before the kernel runs: torch's allocator reuses memory in the order of the stream.
        self._counters = start.address

    def known(self, count: Count) -> int:
        """Wait for a count and return it."""
        return int(count.value)

    # -- arguments that kernels share

    def set_chunk(self, numbers: np.ndarray) -> None:
        """See :meth:`torchpt.engines.kernels.calls.Calls.set_chunk`."""
        self.place.copy_(self.cuda.to_device(torch.from_numpy(numbers)))

    def set_dimensions(self, depth: int, step: int = 0, roulette: float = 0.0) -> None:
        """See :meth:`torchpt.engines.kernels.calls.Calls.set_dimensions`."""
        known = self._salts.get((depth, step))
        if known is None:
            known = self._salts[depth, step] = self.cuda.to_device(salts(depth, torch.device("cpu"), step))
        bound = self._bounds.get(roulette)
        if bound is None:
            bound = self._bounds[roulette] = self.cuda.to_device(torch.tensor([roulette], dtype=torch.float32))
        number = self._depths.get(depth)
        if number is None:
            number = self._depths[depth] = self.cuda.to_device(torch.tensor([depth], dtype=torch.int32))
        self._uniforms |= {"salts": known.data_ptr(), "roulette": bound.data_ptr(), "depth": number.data_ptr()}

    def run(
        self,
        kernel: Kernel,
        count: Count,
        source: Any,
        target: Any,
        places: Any = None,
        lists: list[Any] | None = None,
        slots: Any = None,
    ) -> None:
        """Launch a kernel, see :meth:`torchpt.engines.kernels.calls.Calls.run`."""
        arguments = self._prepared.get(id(kernel))
        if arguments is None:
            arguments = self._prepared[id(kernel)] = self._arguments(kernel)
        arguments.set(source, target, places, slots or self.slots, self._uniforms, lists)
        arguments.words[WORD["counters"]] = self._counters
        self.cuda.launch(arguments.function, arguments.words, count.address, self._max_lanes, self._stream)

    def _arguments(self, kernel: Kernel) -> Arguments:
        """Return new arguments of a kernel, whose code is loaded on the device."""
        search, code = self.kernels.search, kernel.program.function
        arguments = Arguments(kernel, self._row_length, 0 if search is None else search.words.data_ptr())
        arguments.function = self.cuda.load(code.code, code.key)
        return arguments

    # -- adding samples to a film

    def accumulate(
        self, film: Film, chunk: Chunk, address: int, clamp: float | None, clamped: Any, lost: Count
    ) -> None:
        """Launch the kernels that add a chunk's samples to a film, in the order of samples.

        Args:
            film: the film.
            chunk: pixels and samples.
            address: of the samples ``(channels, samples * pixels)``, in rows of an arena's length.
            clamp: largest component of a sample; None: unbounded.
            clamped: memory for the clamped samples.
            lost: is increased by the number of samples that are not finite.
        """
        arguments = self._arguments(self.kernels.accumulate(film.channels, clamp is not None))
        words, first = arguments.words, arguments.tensors
        words[WORD["counters"]] = lost.address
        if clamp is not None:
            limit = torch.full((1,), clamp, dtype=torch.float32, device=self.device)
            words[len(HEAD)] = limit.data_ptr()
        lanes, written = self.lanes(chunk.pixels), None if clamp is None else clamped.address
        for tensors in film_words(film, chunk, address, self._row_length, written):
            words[first:] = tensors
            self.cuda.launch(arguments.function, words, lanes.address, chunk.pixels, self._stream)


# ---- Searches outside of kernels


class DeviceSearch(ChunkSearch):
    """As :class:`ChunkSearch`; searches outside of kernels are tensor operations and wait for the number of rays."""

    def _nearest_outside(self, memory: Any, rows: Rows, o: str, d: str, t_max: str, count: LaneCount) -> None:
        n = self.calls.known(count)
        if n:
            rays = (memory.floats[rows.first(name) :][:size, :n] for name, size in ((o, 3), (d, 3), (t_max, 1)))
            origins, directions, limits = rays
            found = self.kernels.wave.accel.intersect(origins, directions, limits[0])
            for name, values in zip(HIT, found, strict=True):
                memory.put(rows.first(name), 0, values[None])

    def _occluded_outside(self, arena: Any, count: LaneCount) -> None:
        kernels, rows, n = self.kernels, self.kernels.state, self.calls.known(count)
        if n:
            rays = (arena.floats[rows.first(f"shadow_{k}") :][:size, :n] for k, size in (("o", 3), ("d", 3), ("t", 1)))
            origins, directions, limits = rays
            blocked = kernels.wave.accel.occluded(origins, directions, limits[0]).to(torch.int32)
            # 2: the transmittance of the ray is to be computed, see torchpt.search.base.mark_non_opaque.
            arena.put(rows.first("blocked"), 0, (2 * blocked if kernels.has_opacity else blocked)[None])


# ---- The engine


class DeviceEngine(KernelsEngine):
    """The engine of kernels on a device: traces chunks of paths.

    Args:
        kernels: of the render.
        store: see :class:`KernelsEngine`.

    Attributes:
        device_calls: launches the kernels; the same object as ``calls``.
    """

    def __init__(self, kernels: KernelsOnDevice, store: Any = None) -> None:
        self.device_calls = DeviceCalls(kernels)
        super().__init__(kernels, calls=self.device_calls, store=store)
        self._cuda = kernels.cuda
        self._look = LateCheck(kernels.cuda)
        #: Factors of counters in the sums of rays and of truncated paths: block, row, column and factor.
        self._rays: list[tuple[tuple[int, int, int], int]] = []
        self._truncated: list[tuple[tuple[int, int, int], int]] = []

    def _make_search(self) -> ChunkSearch:
        return DeviceSearch(self.calls)

    def _make_joins(self) -> Joins:
        return TensorJoins(self.search)

    def _make_light_paths(self, halt: threading.Event | None) -> DeviceEngine | None:
        light_paths = self.kernels.light_paths
        return DeviceEngine(light_paths, self.store) if isinstance(light_paths, KernelsOnDevice) else None

    def _count_rays(self, lanes: Count, each: int = 1) -> None:
        self._rays += [(counter, each) for counter in lanes.counters] if each else []

    def _count_truncated(self, lanes: Count) -> None:
        self._truncated += [(counter, 1) for counter in lanes.counters]

    def begin_wave(self, chunk: Chunk) -> None:
        """Begin a wave: a chunk, or its layers first and then the chunk."""
        self._rays, self._truncated, self.tally = [], [], RayCounts()
        self.device_calls.begin(chunk.pixels * chunk.samples)

    def launch(self, chunk: Chunk) -> None:
        """Launch all kernels that fill ``slots`` with the radiance of a chunk's samples, after :meth:`begin_wave`."""
        light_paths = self.light_paths
        assert light_paths is None or isinstance(light_paths, DeviceEngine)
        if light_paths is not None:
            self.clear_store(chunk)
            light_paths.begin_wave(chunk)
            light_paths.launch(chunk)
        walk(self, self.spawn(chunk), self.wave.integrator.limits)
        self.mark_lost()
        if light_paths is not None:
            self.take_over(light_paths, chunk)

    def sort(self, paths: Paths) -> Counts:
        """See :class:`torchpt.paths.walk.Engine`; all kinds of hits count as present until no paths are left."""
        counts = super().sort(paths)
        left = self.device_calls.counted()[0] if paths.listed else paths.count
        if self._look.ended(paths.depth - 1, left):
            return Counts((), 0, 0)
        return counts

    def tallies(self) -> Callable[[], RayCounts]:
        """Start to copy the wave's counters to the host; return a function that waits for them and counts rays and paths."""
        copied = self._cuda.to_host(torch.stack(self.device_calls.blocks))
        rays, truncated, known = self._rays, self._truncated, self.tally
        of_light_paths = self.light_paths.tallies() if isinstance(self.light_paths, DeviceEngine) else RayCounts

        def counted() -> RayCounts:
            counters = copied.values().tolist()

            def total(factors: list[tuple[tuple[int, int, int], int]]) -> int:
                return sum(each * counters[block][row][column] for (block, row, column), each in factors)

            more = of_light_paths()
            return RayCounts(known.rays + total(rays) + more.rays, known.truncated + total(truncated) + more.truncated)

        return counted
