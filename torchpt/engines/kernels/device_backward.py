"""Path replay by kernels on a CUDA device, with the gradients of a CPU bit by bit.

Chunks are those of a CPU, traced again and differentiated one after the other by the kernels of
:mod:`~torchpt.engines.kernels.backward`. Their rows of derivatives lie in random order, as do the lanes. They are added in the
order of :mod:`torchpt.math.sums`: sorted by entry and slot, and then each entry's terms one after the other, by the kernel of
:mod:`torchpt.compiler.segments`. The host does not wait for the device within a chunk.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.graph import Unsupported
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.segments import segment_sums
from torchpt.compiler.target import Target
from torchpt.core.memory import Span
from torchpt.engines.kernels.backward import KernelsBackward, VjpKernels
from torchpt.engines.kernels.device import (
    Count,
    DeviceEngine,
    DeviceMemory,
    KernelsOnDevice,
    LateCheck,
    SearchWords,
    on_host,
    search_on_device,
)
from torchpt.engines.kernels.driver import Cuda, Function, cuda_of
from torchpt.engines.kernels.engine import LANES, Chunk, Paths
from torchpt.engines.kernels.layout import Layout
from torchpt.engines.kernels.programs import Kernel, NamedTensors
from torchpt.math import sums
from torchpt.math.sum_kernels import COLUMNS
from torchpt.math.sums import GradientSums, TableSums, entries_and_width
from torchpt.paths.adjoint import Tape

__all__ = ["DeviceBackward", "DeviceChunkSums", "DeviceVjpKernels", "SegmentSums", "device_backward"]


# ---- Sums of terms by entry


class SegmentSums:
    """Adds terms to the rows of a table on a device, in the order of slots.

    Args:
        cuda: the device.
        target: the target that kernels are compiled for.
    """

    def __init__(self, cuda: Cuda, target: Target) -> None:
        self._cuda, self._target = cuda, target
        self._functions: dict[tuple[int, torch.dtype], Function] = {}  # by number of rows and type of the sums

    def add(self, total: Tensor, index: Tensor, values: Tensor, slots: Tensor) -> None:
        """Add ``total[index[k], r] += values[r, k]``, the terms of an entry by rising slot.

        Args:
            total: ``(M, R)`` float64 or float32, in which terms are added.
            index: ``(n,)`` int64, the entry of each term; terms out of range are skipped.
            values: ``(R, n)`` float32; rows may lie apart.
            slots: ``(n,)`` int64, below 2^31; those of an entry are distinct.
        """
        entries, n = len(total), len(index)
        entry = torch.where((index >= 0) & (index < entries), index, entries)
        keys, order = torch.sort((entry << 32) | slots)
        entry, order = keys >> 32, order.int()
        number = torch.arange(n, device=index.device)
        start, end = torch.searchsorted(entry, entry), torch.searchsorted(entry, entry, right=True)
        # The lane of an entry's first term adds all of the entry's; the segments of other lanes are empty.
        adds = (start == number) & (entry < entries)
        found = total.index_select(0, entry.clamp_max(entries - 1)).T.contiguous()
        self._launch(number.int(), torch.where(adds, end, number).int(), found, values, order)
        # Every lane writes, so that the host need not know how many entries there are: the sum of its own entry, or where its
        # term is skipped that of the first lane's.
        writer = torch.where(entry < entries, start, 0)
        total.index_copy_(0, entry[writer].clamp_max(entries - 1), found.T[writer])

    def add_by_columns(self, total: Tensor, index: Tensor, values: Tensor, slots: Tensor) -> None:
        """Add as :meth:`add`, but sum the terms of an entry by columns of slots first, see :mod:`torchpt.math.sums`."""
        entries, width = total.shape
        by_column = total.new_zeros(entries * COLUMNS, width)
        valid = (index >= 0) & (index < entries)
        self.add(by_column, torch.where(valid, index * COLUMNS + slots % COLUMNS, -1), values, slots)
        columns, half = by_column.view(entries, COLUMNS, width), COLUMNS // 2
        while half:
            columns[:, :half] += columns[:, half : 2 * half]
            half //= 2
        total += columns[:, 0]

    def _launch(self, first: Tensor, end: Tensor, found: Tensor, values: Tensor, order: Tensor) -> None:
        """Add segments of ``values`` to ``found (R, n)`` in place, see :func:`torchpt.compiler.segments.segment_sums`."""
        rows, n = found.shape
        function = self._functions.get((rows, found.dtype))
        if function is None:
            stage = segment_sums(rows, "d" if found.dtype == torch.float64 else "f")
            code = cache.compile_stage(stage, self._target).function
            function = self._functions[rows, found.dtype] = self._cuda.load(code.code, code.key)
        uniforms, inputs = [order.data_ptr()], [(x.data_ptr(), n) for x in (first, end, found)]
        words = (ctypes.c_int64 * (len(HEAD) + len(uniforms) + 2 * (len(inputs) + 1)))()
        words[WORD["slots"]], words[WORD["stride"]] = values.data_ptr(), values.stride(0)
        words[len(HEAD) :] = [*uniforms, *(word for pair in (*inputs, inputs[-1]) for word in pair)]
        lanes = torch.full((1,), n, dtype=torch.int64, device=found.device)
        self._cuda.enter()
        self._cuda.launch(function, words, lanes.data_ptr(), n, self._cuda.stream())


class DeviceChunkSums(TableSums):
    """Sums of one chunk on a device; as :class:`torchpt.math.sums.ChunkGradientSums`.

    Args:
        tables: the tables, each ``(..., M)``.
        whole: sums of the pass, to which terms of large tables are added at once.
        segments: adds terms.
    """

    def __init__(self, tables: Sequence[Tensor], whole: GradientSums, segments: SegmentSums) -> None:
        super().__init__(tables)
        self._whole, self._segments = whole, segments
        self.dense: dict[int, Tensor] = {}

    def total(self, number: int) -> Tensor:
        """Return the dense sum of a table as ``(M, R)``."""
        if number not in self.dense:
            table = self.tables[number]
            self.dense[number] = torch.zeros(*entries_and_width(table), dtype=torch.float64, device=table.device)
        return self.dense[number]

    def add_at(self, number: int, index: Tensor, values: Tensor) -> None:
        """Add ``values (..., n)`` to the entries ``index (n,)`` of a table; a term's number serves as its slot."""
        _, width = entries_and_width(self.tables[number])
        slots = torch.arange(len(index), device=index.device)
        self.add_rows(number, index.long(), values.reshape(width, -1).contiguous(), slots)

    def add_rows(self, number: int, index: Tensor, values: Tensor, slots: Tensor) -> None:
        """Add ``values (R, n)`` to the entries ``index (n,)`` of a table; arguments as for :meth:`SegmentSums.add`."""
        size = self.tables[number].numel()
        if size > sums.MAX_DENSE:
            self._segments.add(self._whole.total(number), index, values, slots)
        elif size > sums.MAX_BY_COLUMNS:
            self._segments.add(self.total(number), index, values, slots)
        else:
            self._segments.add_by_columns(self.total(number), index, values, slots)

    def add_all(self, number: int, values: Tensor, counts: Tensor, slots: Tensor) -> None:
        """Add derivatives by a whole table: the sums of ``values (table.numel(), n)`` over lanes where ``counts`` is set."""
        table = self.tables[number]
        total = torch.zeros(1, table.numel(), dtype=torch.float64, device=table.device)
        # The table as a single entry, number 0, to which all lanes belong.
        self._segments.add_by_columns(total, torch.where(counts, 0, -1), values, slots)
        self.add(number, total.view(table.shape))

    def merge_into_whole(self) -> None:
        """Add the sums of small tables to those of the pass."""
        for number, total in self.dense.items():
            self._whole.total(number).add_(total)


# ---- The kernels of a backward pass


class _HostVjpKernels(VjpKernels):
    """Kernels on the host that stages are traced with; none is run, so they have no search."""

    def _search_inputs(self) -> tuple[None, None]:
        return None, None


class DeviceVjpKernels(KernelsOnDevice, VjpKernels):
    """The kernels of one backward pass on a device.

    Args:
        tape: the wave and its differentiated tensors, on the device.
        cotangent: see :class:`~torchpt.engines.kernels.backward.VjpKernels`.
        cuda: the device.
        target: see :class:`~torchpt.engines.kernels.device.KernelsOnDevice`.
        search: see there.
    """

    def __init__(
        self, tape: Tape, cotangent: Tensor | None, cuda: Cuda, target: Target, search: SearchWords | None
    ) -> None:
        super().__init__(cuda, target, search, tape, search is not None, cotangent)
        self.segments = SegmentSums(cuda, target)

    def _host_inputs(self) -> tuple[Layout, NamedTensors]:
        known: dict[int, Tensor] = {}
        wave = on_host(self.tape.wave, known)
        primals = [known.setdefault(id(primal), primal.cpu()) for primal in self.tape.primals]
        leaves = [primal.detach().requires_grad_() for primal in primals]
        known |= {id(leaf): copy for leaf, copy in zip(self.tape.leaves, leaves, strict=True)}
        tape = Tape(wave, on_host(self.tape.taped, known), leaves, primals, captured=())
        kernels = _HostVjpKernels(tape, self.packets, None if self.cotangent is None else self.cotangent.cpu())
        return kernels, kernels._leaves

    def engine(self) -> DeviceBackward:
        """Return an engine."""
        return DeviceBackward(self)

    def chunk_sums(self, whole: GradientSums) -> DeviceChunkSums:
        """Return sums of a chunk, which go to those of the pass."""
        return DeviceChunkSums(self.tape.tables, whole, self.segments)


def device_backward(
    tape: Tape,
    own: Sequence[int],
    cotangent: Tensor | None,
    packets: bool,
    cuda: Cuda | None = None,
    target: Callable[[int], Target] = ptx_target,
) -> DeviceVjpKernels:
    """Return the kernels of a backward pass on a device.

    Args:
        tape: see :class:`DeviceVjpKernels`.
        own: indices of the user's own models, which are compiled at once to find out whether they can be.
        cotangent: see :class:`DeviceVjpKernels`.
        packets: True: rays are searched by kernels where these can; False: by the wave's acceleration structure.
        cuda: the device; None: that of the wave.
        target: returns the target of a row length.

    Raises:
        RenderError: kernels cannot run on the device.
    """
    device = cuda_of(tape.wave.centre.device) if cuda is None else cuda
    search = search_on_device(tape.wave.accel, packets, device.device)
    cotangent = None if cotangent is None else cotangent.float().contiguous()
    kernels = DeviceVjpKernels(tape, cotangent, device, target(LANES), search)
    kernels.eager = kernels.probe(own)
    return kernels


# ---- The backward engine


@dataclass(frozen=True)
class Mark:
    """Checkpoint of a replay: copies of an arena before its lanes were listed, and of the number of lanes."""

    depth: int
    words: Tensor
    count: Tensor


class DeviceBackward(DeviceEngine, KernelsBackward):
    """Backward engine of kernels on a device; see :class:`torchpt.engines.engine.Backward`.

    The verbs of the walk are those of :class:`DeviceEngine`; :class:`KernelsBackward` has the order of the backward pass.

    Args:
        kernels: :class:`DeviceVjpKernels` of the backward pass.
    """

    def begin(self, span: Span, sums: Any) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`; ``sums``: :class:`DeviceChunkSums`."""
        self.sums, self._chunk, self._first = sums, Chunk(*span), 1
        n = self._chunk.pixels * self._chunk.samples
        self.begin_wave(self._chunk)
        paths: Any = self.spawn(self._chunk)
        self._weight = None
        if "weight" in self.kernels.state:
            self._weight = paths.arena.floats[self.kernels.state.first("weight"), :n].clone()
        return paths

    def mark(self, paths: Paths) -> Any:
        """See :class:`torchpt.engines.engine.Backward`."""
        arena: Any = paths.arena
        return Mark(paths.depth, arena.words.clone(), paths.count.value.clone())

    def resume(self, mark: Any) -> Paths:
        """See :class:`torchpt.engines.engine.Backward`."""
        self._first = mark.depth
        self._lost.clear()
        self._look = LateCheck(self._cuda)
        paths: Any = self._begin(self.room(mark.depth), mark.depth, Count(mark.count, ()))
        paths.arena.words.copy_(mark.words)
        paths.arrived = True
        return paths

    def radiance_of_samples(self) -> Tensor:
        """See :class:`torchpt.engines.engine.Backward`."""
        self.mark_lost()
        slots: Any = self.slots
        return slots.floats[:, : self._chunk.pixels * self._chunk.samples]

    def receive(self, cotangent: Tensor) -> None:
        """See :class:`torchpt.engines.engine.Backward`."""
        n, first, slots = cotangent.shape[1], self.back.slots.first("radiance"), self._device_slots()
        slots.words[:, :n] = 0
        slots.floats[first : first + 3, :n] = cotangent if self._weight is None else cotangent * self._weight

    def _device_slots(self) -> DeviceMemory:
        slots: Any = self._sample_slots
        return slots

    def _vjp_of_stage(self, key: tuple, paths: Paths, places: Any, count: Any, *, added: bool) -> None:
        """Pull cotangents back through one stage on the lanes of a list, by its kernel.

        Raises:
            Unsupported: the stage cannot be compiled.
        """
        kernel = self.back.vjp_kernel(key)
        if kernel is None:
            raise Unsupported(self.back.eager_vjps[key])
        self._results = self._results_of(kernel)
        self.calls.run(kernel, count, paths.arena, self._results, places, slots=self._sample_slots)
        if not kernel.program.sums:
            return
        arena: Any = paths.arena
        lanes = places.words[0].long()
        exists = torch.arange(len(lanes), device=lanes.device) < count.value
        slots = arena.words[self.back.state.first("lane")].index_select(0, lanes).long()
        self._add_sums(kernel, exists, slots)

    def _add_sums(self, kernel: Kernel, count: Any, slots: Any) -> None:
        """Add the rows that a VJP's kernel wrote.

        Args:
            kernel: the kernel.
            count: ``(row,)`` bool, True for the lanes that exist; or their number, the first ones.
            slots: ``(row,)`` of the lanes, distinct where they exist; or an array of the first ones.
        """
        results: Any = self._results
        if isinstance(count, int):
            slots = torch.arange(results.words.shape[1], device=results.words.device)
            count = slots < count
        exists = count
        for number, index, first, width in kernel.program.sums:
            values = results.floats[first : first + width]
            if index < 0:
                self.sums.add_all(number, values, exists, slots)
            else:
                self.sums.add_rows(number, torch.where(exists, results.words[index], -1).long(), values, slots)

    def _ray_cotangents(self, row: int, n: int) -> Tensor:
        return self._device_slots().floats[row : row + 3, :n].clone()
