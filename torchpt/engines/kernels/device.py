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
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.program import LaidOut, Program, Tables, bind_tables
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.sinks import Sinks
from torchpt.compiler.target import Target
from torchpt.core.memory import Budget, Span, explain_out_of_memory, fits_in_memory
from torchpt.core.tree import moved
from torchpt.engines.kernels.calls import Arguments, LaneCount
from torchpt.engines.kernels.driver import Cuda, HostCopy, cuda_of
from torchpt.engines.kernels.engine import Chunk, KernelsEngine, Paths, count_samples, film_words
from torchpt.engines.kernels.joins import Joins, TensorJoins
from torchpt.engines.kernels.layout import HIT, Block, Layout, Rows
from torchpt.engines.kernels.programs import Kernel, Kernels, NamedTensors, probed_kernels, records_of, trace_stage
from torchpt.engines.kernels.searches import ChunkSearch
from torchpt.engines.kernels.stages import CHUNK_FIELDS
from torchpt.engines.work import SampleRange, TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.walk import Counts, walk
from torchpt.paths.wave import PixelSet, RayCounts, Wave, clamp_scale
from torchpt.physics.film import Film
from torchpt.physics.samplers import salts
from torchpt.search import Accel, build
from torchpt.search.brute import Brute
from torchpt.search.instance_rays import instance_search, instance_tables
from torchpt.search.instances import Instanced
from torchpt.search.lbvh import Lbvh
from torchpt.search.tree import WideBvh
from torchpt.search.tree_instances import InstancedWideBvh
from torchpt.search.tree_rays import TreeSearch, tree_search, tree_tables

__all__ = [
    "CHECK_EVERY",
    "MAX_LANES",
    "Count",
    "DeviceCalls",
    "DeviceEngine",
    "DeviceForward",
    "DeviceKernels",
    "DeviceMemory",
    "KernelsOnDevice",
    "LateCheck",
    "SearchWords",
    "device_forward",
    "device_kernels",
    "on_host",
    "search_on_device",
]

#: Steps between two checks of a loop without a fixed end for lanes that are left.
CHECK_EVERY = 4
#: Most lanes of a wave: some hundred launches of a few microseconds each are then short beside the work.
MAX_LANES = 1 << 20
#: Fewest lanes of a wave; the number of lanes is a multiple of it.
MIN_LANES = 1 << 10
#: Rows of counters that are allocated, and set to 0, at once.
_COUNTER_ROWS = 64


# ---- Kernels and their tables on the device


def on_host(wave: Wave, known: dict[int, Tensor]) -> Wave:
    """Return a wave with all tensors on the host, to trace stages with; its search is left as it is.

    ``known``: tensors of the host by the id of the device's, used in place of new copies; new ones are added.
    """
    host = torch.device("cpu")
    filter = type(wave.filter)(wave.filter.values, host)
    there = moved(replace(wave, light_paths=None), host, known)
    context = replace(there.context, filter=None if there.context.filter is None else filter)
    return replace(there, context=context, filter=filter)


class _HostLeaves(Mapping[str, Tensor]):
    """Copies of a render's tensors on the host, made when they are first read.

    Args:
        leaves: the tensors on the device by path.
    """

    def __init__(self, leaves: Mapping[str, Tensor]) -> None:
        self._leaves = leaves
        self._copies: dict[str, Tensor] = {}

    def __getitem__(self, path: str) -> Tensor:
        if path not in self._copies:
            self._copies[path] = self._leaves[path].detach().cpu()
        return self._copies[path]

    def __iter__(self) -> Iterator[str]:
        return iter(self._leaves)

    def __len__(self) -> int:
        return len(self._leaves)


class KernelsOnDevice(Kernels, ABC):
    """Base of kernels that run on a device; it comes before the other base of a class, which says what kernels there are.

    Args:
        cuda: the device.
        target: the target that stages are compiled for; its form has the row length of arenas.
        search: from :func:`search_on_device`; None: rays are searched outside of kernels.
        arguments: of the other base.

    Attributes:
        row: number of lanes of an arena.
    """

    def __init__(self, cuda: Cuda, target: Target, search: SearchWords | None, *arguments: Any) -> None:
        self.cuda, self.target, self.row = cuda, target, target.form.row
        self._search = search
        self._host: tuple[Layout, NamedTensors] | None = None
        self.tree = None if search is None else search.tree
        super().__init__(*arguments)
        #: What prologues read: torch's operators round differently on a GPU.
        self._host_leaves = _HostLeaves(self._leaves.tensors)

    @abstractmethod
    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        """Return layout and leaves on the host, to trace stages with."""

    def _search_inputs(self) -> tuple[Any, None]:
        return self._search, None

    def _program(self, key: tuple[Any, ...], listed: bool, build: Callable[[Any], Sinks]) -> Program:
        """Return the program of a stage, traced on the host if it is new."""

        def trace() -> Any:
            if self._host is None:
                self._host = self._host_inputs()
            layout, leaves = self._host
            layout.tree = self.tree
            return trace_stage(leaves, layout, build, listed)

        return cache.program_of((key, self.structure), self._host_leaves, trace, self.target)

    def _bind(self, program: Program, kept: Sequence[LaidOut | None]) -> Tables:
        return bind_tables(
            program.tables,
            program.steps,
            program.constants,
            self._host_leaves,
            self._laid_out,
            program.names,
            self._results,
            self.cuda.device,
            self._leaves.tensors,
            kept,
            program.in_order,
        )


class DeviceKernels(KernelsOnDevice):
    """The kernels of one render on a device.

    Args:
        wave: the render; its tensors are on the device.
        cuda: the device.
        target: see :class:`KernelsOnDevice`.
        search: see there.
        fused: True: the search is part of the stages.
        before: see :class:`Kernels`.
        fixed: see there.
    """

    def __init__(
        self,
        wave: Wave,
        cuda: Cuda,
        target: Target,
        search: SearchWords | None,
        fused: bool,
        before: Kernels | None = None,
        fixed: bool = False,
    ) -> None:
        super().__init__(cuda, target, search, wave, search is not None, fused, before, fixed)

    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        layout = Layout(on_host(self.wave, {}), self.by_kernels, self.fused)
        return layout, NamedTensors(records_of(layout, None))


@dataclass(frozen=True)
class SearchWords:
    """The argument of searches in kernels, on a device.

    Attributes:
        words: int64, see :func:`torchpt.compiler.packet.scene_words`, :func:`torchpt.search.tree.scene_words` and
            :func:`torchpt.search.instance_rays.instance_tables`.
        tables: tensors whose addresses are the first words.
        tree: see :class:`~torchpt.engines.kernels.layout.Layout`.
        host: the search of the host that the tables were copied from.
    """

    words: Tensor
    tables: tuple[Tensor, ...]
    tree: TreeSearch | None
    host: Accel


def _host_search(accel: Accel, before: SearchWords | None = None) -> Accel | None:
    """Return the search, on the host, whose data kernels of a device read; None if they know none for this one.

    ``before``: of an earlier render. Its tree is refitted to primitives that have moved, where that is good enough.
    """
    if isinstance(accel, Instanced):
        accel = accel.base
    if isinstance(accel, Lbvh):
        return build(moved(accel.geometry, torch.device("cpu")), before=None if before is None else before.host)
    return None if isinstance(accel, Brute) and accel.quadrics else accel


#: Searches that were copied to devices, by the accel of the scene.
_ON_DEVICE: WeakKeyDictionary[Accel, dict[torch.device, SearchWords | None]] = WeakKeyDictionary()


def search_on_device(
    accel: Accel, by_kernels: bool, device: torch.device, before: Kernels | None = None
) -> SearchWords | None:
    """Return the argument of searches in kernels of a scene, on a device; None: rays are searched outside of kernels.

    Args:
        accel: the scene's acceleration structure.
        by_kernels: False: only ``accel`` itself is searched by kernels, not a tree of tensors by another one.
        device: where kernels run.
        before: kernels of an earlier render, whose tree may be refitted.
    """
    if not by_kernels and not isinstance(accel, Brute):
        return None
    found = _ON_DEVICE.setdefault(accel, {})
    if device not in found:
        host = _host_search(accel, before.search if isinstance(before, KernelsOnDevice) else None)
        found[device] = None if host is None else _copied(host, device)
    return found[device]


def _copied(host: Accel, device: torch.device) -> SearchWords | None:
    """Return a search of the host on a device; None if kernels do not know it."""
    tree: TreeSearch | None = None
    if isinstance(host, Brute):
        tables = tuple(table.numpy() for table in host.tables)
        numbers = np.frombuffer(host.words, np.int64)[len(tables) :]
    elif isinstance(host, WideBvh):
        (tables, numbers), tree = tree_tables(host), tree_search(host)
    elif isinstance(host, InstancedWideBvh):
        (tables, numbers), tree = instance_tables(host), instance_search(host)
    else:
        return None
    copies = tuple(torch.from_numpy(table).to(device) for table in tables)
    addresses = np.array([table.data_ptr() for table in copies])
    return SearchWords(torch.from_numpy(np.concatenate([addresses, numbers])).to(device), copies, tree, host)


# ---- Memory, counters and launches


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
            bound = self._bounds[roulette] = self.cuda.to_device(torch.tensor([roulette]))
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
        spare: slots of the next wave.
    """

    def __init__(self, kernels: KernelsOnDevice, store: Any = None) -> None:
        self.device_calls = DeviceCalls(kernels)
        super().__init__(kernels, calls=self.device_calls, store=store)
        self.spare = self.device_calls.memory(3)
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


# ---- The forward engine


@dataclass
class _Launched:
    """A wave that was launched, and is finished on the host while the next one runs.

    Attributes:
        chunk: its pixels and samples.
        pixel_set: the films.
        tally: returns the counts of rays and paths, after a wait.
        lost: number of samples that are not finite, on its way to the host.
        slots: radiance of the samples.
        light: sums of radiance before and after the clamp, on their way to the host.
        rays: rays of layers.
    """

    chunk: Chunk
    pixel_set: PixelSet
    tally: Callable[[], RayCounts]
    lost: HostCopy
    slots: Any
    light: HostCopy | None
    rays: int


def device_kernels(
    wave: Wave,
    own: Sequence[int],
    cuda: Cuda,
    target: Target,
    search: SearchWords | None,
    before: Kernels | None = None,
) -> DeviceKernels:
    """Return the kernels of a render on a device; its ``eager`` lists models that cannot be compiled, with the reasons.

    Args:
        wave: of the render, on the device.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        cuda: the device.
        target: see :class:`DeviceKernels`.
        search: see :class:`KernelsOnDevice`. A tree is searched by kernels of its own, with fewer registers than stages need.
        before: kernels of another render; its tables are shared where they were made of the same tensors.
    """
    packets = search is not None and search.tree is None
    make = partial(DeviceKernels, wave, cuda, target, search, before=before, fixed=not own)
    kernels = probed_kernels(wave, own, packets, make)
    if wave.light_paths is not None:
        earlier = None if before is None else before.light_paths
        kernels.light_paths = device_kernels(wave.light_paths, own, cuda, target, search, earlier)
    return kernels


def device_forward(
    wave: Wave,
    own: Sequence[int],
    by_kernels: bool,
    before: Kernels | None = None,
    cuda: Cuda | None = None,
    target: Callable[[int], Target] = ptx_target,
    lanes: int = MAX_LANES,
) -> DeviceForward:
    """Return the forward engine of a wave on a device.

    Args:
        wave: of the render, on the device.
        own: see :func:`device_kernels`.
        by_kernels: True: rays are searched by kernels where these can; False: by the wave's acceleration structure.
        before: see :func:`device_kernels`.
        cuda: the device; None: that of the wave.
        target: returns the target of a row length.
        lanes: most lanes of a wave.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    device = cuda_of(wave.centre.device) if cuda is None else cuda
    search = search_on_device(wave.accel, by_kernels, device.device, before)
    last = before

    def make(row: int) -> DeviceKernels:
        nonlocal last
        last = device_kernels(wave, own, device, target(row), search, last)
        return last

    return DeviceForward(make, device, wave, lanes, wave.integrator.strict)


class DeviceForward:
    """Forward engine of kernels on a device, see :class:`torchpt.engines.engine.Forward`.

    Args:
        make: makes the kernels for a row length.
        cuda: the device.
        wave: of the render.
        lanes: most lanes of a wave.
        strict: True: the render ends at the first sample that is not finite, so each wave is waited for.
    """

    compiled = True

    def __init__(
        self, make: Callable[[int], DeviceKernels], cuda: Cuda, wave: Wave, lanes: int = MAX_LANES, strict: bool = False
    ) -> None:
        self._make, self.cuda, self.wave, self.strict = make, cuda, wave, strict
        self.budget = Budget(
            cuda.device, lanes, what="a wave of the fewest lanes", fallback="waves of fewer lanes", min_lanes=MIN_LANES
        )
        self.kernels = make(lanes)
        self._seconds = 0.0  # of kernels that were replaced
        self._made: DeviceEngine | None = None
        self._clamped: Any = None

    @property
    def seconds(self) -> float:
        """Return the seconds spent on making kernels."""
        return self._seconds + self.kernels.seconds

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a lane takes, for these layers."""
        return self.kernels.rows(layers) + 6  # slots of a second wave, and clamped samples

    def release_workers(self, keeps: bool) -> None:
        """Release the memory of waves; torch's allocator keeps it for the next render."""
        self._made = self._clamped = None

    def run(self, spans: Sequence[SampleRange], each: Callable[[TaskResult | None], bool]) -> bool:
        """See :class:`torchpt.engines.engine.Forward`. The host is one wave behind the device."""
        behind: deque[_Launched] = deque()  # waves that are not finished on the host
        for pixel_set, first, count in spans:
            pixels = pixel_set.film.width * pixel_set.film.height
            self._engine()  # settles the number of lanes
            launch = partial(self._launch, behind, pixel_set)
            for _ in self.budget.run_in_chunks(launch, pixels, first, count):
                while len(behind) > (0 if self.strict else 1):
                    if each(self._result_of(behind.popleft())):
                        return self._report_rest(behind, each)
        while behind:
            if each(self._result_of(behind.popleft())):
                return False
        return True

    def _engine(self) -> DeviceEngine:
        """Return the engine, with memory for as many lanes as the budget allows."""
        while True:
            row = max(self.budget.lanes // MIN_LANES * MIN_LANES, MIN_LANES)
            if self._made is not None and self.kernels.row == row:
                return self._made
            self.release_workers(keeps=False)
            self.budget.lanes = row
            if row != self.kernels.row:
                self._seconds += self.kernels.seconds
                self.kernels = self._make(row)
            if not fits_in_memory(self._make_engine):
                self.budget.shrink()

    def _make_engine(self) -> None:
        self._made = DeviceEngine(self.kernels)

    def _launch(self, behind: deque[_Launched], pixel_set: PixelSet, span: Span) -> None:
        """Launch the kernels of a wave and append it to ``behind``.

        Memory that runs out before samples are added to films leaves the films as they were.

        Raises:
            RenderError: memory ran out while samples were added.
        """
        engine, clamp, chunk = self._engine(), self.wave.integrator.clamp, Chunk(*span, pixel_set)
        calls = engine.device_calls
        engine.begin_wave(chunk)
        names, rays = tuple(pixel_set.layers), 0
        if names:
            rays = engine.layers(chunk, names)
            engine.begin_wave(chunk)  # its tally is that of the chunk alone
        light = None
        if self.wave.integrator.light:
            # Slots of the wave before are read until it is finished.
            calls.slots, engine.spare = engine.spare, calls.slots
            engine.slots = calls.slots
            engine.launch(chunk)
        with explain_out_of_memory("the sums of a film"):
            lost = calls.lanes(0)
            if self.wave.integrator.light:
                light = self._add(engine, chunk, pixel_set.film, clamp, lost)
            shown: Any = engine.shown
            first = 0
            for film in pixel_set.layers.values():
                address = shown.address + 4 * self.kernels.row * first
                calls.accumulate(film, chunk, address, None, None, calls.lanes(0))
                count_samples(film, chunk, shown.floats[first : first + film.channels])
                first += film.channels
            copied = self.cuda.to_host(lost.value)
            behind.append(_Launched(chunk, pixel_set, engine.tallies(), copied, calls.slots, light, rays))

    def _add(self, engine: DeviceEngine, chunk: Chunk, film: Film, clamp: float | None, lost: Count) -> HostCopy | None:
        """Add the radiance and the splats of a chunk to the film; return the light before and after the clamp."""
        calls, used = engine.device_calls, chunk.pixels * chunk.samples
        if clamp is not None and self._clamped is None:
            self._clamped = calls.memory(3)
        calls.accumulate(film, chunk, calls.slots.address, clamp, self._clamped, lost)
        values = calls.slots.floats if clamp is None else self._clamped.floats
        count_samples(film, chunk, values)
        light = None
        if clamp is not None:
            plain = calls.slots.floats[:, :used]
            plain = torch.where(torch.isfinite(plain).all(0), plain, 0.0)
            light = torch.stack((plain.double().sum(), values[:, :used].double().sum()))
        for splats in engine.splats:
            value = splats.value
            if clamp is not None and light is not None:
                value = value * clamp_scale(value, clamp)
                light = light + torch.stack((splats.value.double().sum(), value.double().sum()))
            assert film.splats is not None
            stream = film.randomization_of(chunk.first_sample + splats.lane // chunk.pixels)
            sums, place, total = film.splats.writes_of_add(stream, splats.pixel, value)
            sums.index_copy_(2, place, total)
        return None if light is None else self.cuda.to_host(light)

    def _report_rest(self, behind: deque[_Launched], each: Callable[[TaskResult | None], bool]) -> bool:
        """Report the waves that were launched before the render was to end; return False."""
        while behind:
            each(self._result_of(behind.popleft()))
        return False

    def _result_of(self, wave: _Launched) -> TaskResult:
        """Return the result of a wave, after a wait."""
        chunk, used = wave.chunk, wave.chunk.pixels * wave.chunk.samples
        result = TaskResult(wave.tally(), used if self.wave.integrator.light or wave.rays else 0)
        result.tally.rays += wave.rays
        if wave.light is not None:
            before, after = wave.light.values().tolist()
            result.light = before, after
        if int(wave.lost.values()):
            radiance = wave.slots.floats[:, :used].view(3, chunk.samples, chunk.pixels)
            result.lost = NonFinite.of(radiance, chunk.first_pixel, chunk.first_sample, self.wave.crop, wave.pixel_set)
        return result
