"""Calls of kernels by one thread: counters, and arguments that are prepared once."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch

from torchpt.compiler.form import CAPACITY
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.engines.kernels.layout import Memory
from torchpt.engines.kernels.programs import Kernel, Kernels
from torchpt.engines.kernels.stages import CHUNK_FIELDS
from torchpt.physics.samplers import salts

__all__ = ["Arguments", "Calls", "Halted", "LaneCount"]


#: A number of lanes: an int, or on a device a :class:`torchpt.engines.kernels.device.Count`, which is always true.
LaneCount = Any


class Halted(Exception):
    """Raised where a kernel is called after the render was cancelled."""


class Arguments:
    """The argument block of a kernel, with the words that stay the same filled in.

    Args:
        kernel: the kernel.
        row: elements of a row of the arenas.
        search: address of the argument of searches; 0: none.

    Attributes:
        words: a ctypes array of int64, see :func:`torchpt.compiler.kernel.argument_words`.
        tensors: index of the first word of the tensors.
        function: what runs the kernel, for the caller to set.
    """

    __slots__ = ("_lists", "_uniforms", "function", "kernel", "tensors", "words")

    def __init__(self, kernel: Kernel, row: int, search: int = 0) -> None:
        program, first_list = kernel.program, len(HEAD) + len(kernel.program.uniforms)
        self.kernel = kernel
        self.function: Any = None
        self._uniforms = tuple((len(HEAD) + k, name) for k, name in enumerate(program.uniforms))
        self.tensors = first_list + program.lists
        self._lists = range(first_list, self.tensors)
        self.words: Any = (ctypes.c_int64 * (self.tensors + 2 * (program.tensors + program.results)))()
        self.words[WORD["stride"]], self.words[WORD["tables"]] = row, kernel.tables.address
        self.words[WORD["search"]] = search

    def set(
        self, source: Any, target: Any, places: Any, slots: Any, uniforms: Mapping[str, int], lists: list[Any] | None
    ) -> None:
        """Set the words that differ from call to call: addresses of memory, and of each uniform by name."""
        words = self.words
        words[0], words[1], words[3] = source.address, target.address, slots.address  # of HEAD: src, dst, slots
        if places is not None:
            words[2] = places.address
        for word, name in self._uniforms:
            words[word] = uniforms[name]
        if lists is not None:
            for word, memory in zip(self._lists, lists, strict=False):
                words[word] = memory.address


class Calls:
    """Calls the kernels of a render from one thread.

    Args:
        kernels: of the render.
        halt: set to cancel the render.

    Attributes:
        counters: int64: number of lanes in the arena, then in each list (:class:`torchpt.engines.kernels.layout.Layout`).
        place: pixels and samples of the chunk, see :data:`torchpt.engines.kernels.stages.CHUNK_FIELDS`.
        slots: radiance of the chunk's samples, three rows.
    """

    def __init__(self, kernels: Kernels, halt: threading.Event) -> None:
        self.kernels, self._halt = kernels, halt
        self.counters = np.zeros(kernels.models + 6, np.int64)
        self.place = np.zeros(len(CHUNK_FIELDS), np.int32)
        self.slots = Memory(3)
        self._prepared: dict[int, Arguments] = {}  # by id of the kernel, which they refer to
        self._salts: dict[tuple[int, int], Any] = {}  # by depth and step
        self._bounds: dict[float, np.ndarray] = {}  # of survival probabilities, as uniforms
        self._depths: dict[int, np.ndarray] = {}  # numbers of vertices, likewise
        self._start_salts = salts(0, torch.device("cpu"))
        # Address of each uniform.
        self._merging = np.ones(1, np.float32)
        self._uniforms = {
            "place": self.place.ctypes.data,
            "start_salts": self._start_salts.data_ptr(),
            "merging": self._merging.ctypes.data,
        }

    def unbind(self) -> None:
        """Drop all references to the render and its kernels."""
        del self.kernels, self._halt
        self._prepared.clear()

    def rebind(self, kernels: Kernels, halt: threading.Event) -> None:
        """Use the kernels of another render of the same structure, which has the same memory layout."""
        self.kernels, self._halt = kernels, halt

    def memory(self, rows: int) -> Memory:
        """Return new memory for kernels."""
        return Memory(rows)

    def clear(self) -> None:
        """Set all counters to 0."""
        self.counters[:] = 0

    def counted(self) -> tuple[LaneCount, list[LaneCount]]:
        """Return how many lanes are in the arena, and how many in each list: one a model, on emitters, without a hit."""
        return int(self.counters[0]), self.counters[1 : self.kernels.models + 3].tolist()

    def lanes(self, count: int) -> LaneCount:
        """Return a known number of lanes as a count."""
        return count

    def left(self, step: int) -> LaneCount:
        """Return how many rays the last kernel left in transit, as counter 0 says; ``step``: number of that kernel, from 0."""
        return int(self.counters[0])

    def running_sums(self, counts: Sequence[LaneCount]) -> tuple[list[LaneCount], LaneCount]:
        """Return for each count the sum of those before it, and the sum of all."""
        sums = [0, *accumulate(counts)]
        return sums[:-1], sums[-1]

    def write_from(self, start: LaneCount) -> None:
        """Set the first index that a kernel with a ``shift`` writes to, see :class:`torchpt.compiler.sinks.Sinks`."""
        self.counters[0] = start

    def known(self, count: LaneCount) -> int:
        """Return a count as an int."""
        return count

    def set_merging(self, merging: float) -> None:
        """Set the ratio of densities of a merge."""
        self._merging[:] = merging

    def set_chunk(self, numbers: np.ndarray) -> None:
        """Set the chunk: int32 numbers, see :data:`torchpt.engines.kernels.stages.CHUNK_FIELDS`."""
        self.place[:] = numbers

    def set_dimensions(self, depth: int, step: int = 0, roulette: float = 0.0) -> None:
        """Set the random dimensions of kernels to those of a vertex, and of a step of transmission before it.

        ``roulette``: upper bound of the survival probability, for kernels that have it as an input.
        """
        vertex_salts = self._salts.get((depth, step))
        if vertex_salts is None:
            vertex_salts = self._salts[depth, step] = salts(depth, torch.device("cpu"), step)
        bound = self._bounds.get(roulette)
        if bound is None:
            bound = self._bounds[roulette] = np.array([roulette], np.float32)
        number = self._depths.get(depth)
        if number is None:
            number = self._depths[depth] = np.array([depth], np.int32)
        self._uniforms |= {
            "salts": vertex_salts.data_ptr(),
            "roulette": bound.ctypes.data,
            "depth": number.ctypes.data,
        }

    def run(
        self,
        kernel: Kernel,
        count: LaneCount,
        source: Memory,
        target: Memory,
        places: Memory | None = None,
        lists: list[Memory] | None = None,
        slots: Memory | None = None,
    ) -> None:
        """Run a kernel: one step.

        Args:
            kernel: of the render.
            count: number of lanes.
            source: the arena that it reads.
            target: the arena that it writes.
            places: list of lanes, if the kernel reads lanes by a list.
            lists: lists that it appends lanes to.
            slots: memory for results by sample; None: the radiance of the samples.

        Raises:
            Halted: the render was cancelled.
        """
        if self._halt.is_set():
            raise Halted
        arguments = self._prepared.get(id(kernel))
        if arguments is None:
            arguments = self._prepared[id(kernel)] = self._prepare(kernel)
        arguments.set(source, target, places, slots or self.slots, self._uniforms, lists)
        arguments.function(count)

    def _prepare(self, kernel: Kernel) -> Arguments:
        search = self.kernels.search
        arguments = Arguments(kernel, CAPACITY, 0 if search is None else ctypes.addressof(search))
        arguments.words[WORD["counters"]] = self.counters.ctypes.data
        function, address = kernel.program.function, ctypes.addressof(arguments.words)
        arguments.function = lambda count: function.call(address, count)  # quick code may be replaced
        return arguments
