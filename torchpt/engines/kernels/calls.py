"""How one thread calls kernels: counters, and arguments that are filled in once."""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import numpy as np
import torch

from torchpt.engines.kernels.kernels import Kernel, Kernels
from torchpt.engines.kernels.rows import Memory
from torchpt.engines.kernels.vertex import PLACE
from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.kernel import HEAD
from torchpt.samplers import salts

__all__ = ["Calls", "Halted"]

_WORD = {name: k for k, name in enumerate(HEAD)}


class Halted(Exception):
    """The render is to end."""


class Calls:
    """Calls of a render's kernels by one thread.

    Args:
        kernels: of the render.
        halt: set where the render is to end.

    Attributes:
        counters: see :class:`torchpt.engines.kernels.layout.Layout`.
        place: which samples the chunk holds, see :data:`torchpt.engines.kernels.vertex.PLACE`.
        slots: radiance of the chunk's samples.
    """

    def __init__(self, kernels: Kernels, halt: threading.Event) -> None:
        self.kernels, self._halt = kernels, halt
        self.counters = np.zeros(kernels.models + 6, np.int64)
        self.place = np.zeros(len(PLACE), np.int32)
        self.slots = Memory(3)
        self._prepared: dict[int, tuple[Any, Any, int, tuple[tuple[int, str], ...], range]] = {}
        self._keep: list[Kernel] = []
        self._salts: dict[tuple[int, int], Any] = {}
        self._uniforms = {"place": self.place.ctypes.data}

    def leave(self) -> None:
        """Let go of the render and its kernels."""
        del self.kernels, self._halt
        self._prepared.clear()
        self._keep.clear()

    def serve(self, kernels: Kernels, halt: threading.Event) -> None:
        """Go on with the kernels of another render of the same structure, whose memory looks the same."""
        self.kernels, self._halt = kernels, halt

    def clear(self) -> None:
        """Start to count anew."""
        self.counters[:] = 0

    def counted(self) -> tuple[int, list[int]]:
        """Return how many lanes are in the arena, and how many in each list."""
        return int(self.counters[0]), self.counters[1 : self.kernels.models + 3].tolist()

    def name_salts(self, depth: int, step: int = 0) -> None:
        """Set the vertex, or the step on the way there, whose random dimensions kernels draw from."""
        known = self._salts.get((depth, step))
        if known is None:
            known = self._salts[depth, step] = salts(depth, torch.device("cpu"), step)
        self._uniforms["salts"] = known.data_ptr()

    def run(
        self,
        kernel: Kernel,
        count: int,
        source: Memory,
        target: Memory,
        places: Memory | None = None,
        lists: list[Memory] | None = None,
        slots: Memory | None = None,
    ) -> None:
        """Run a kernel.

        Args:
            kernel: of the render.
            count: how many lanes.
            source: the arena that it reads.
            target: the arena that it writes.
            places: the lanes, where the kernel takes them by a list.
            lists: what it notes lanes in.
            slots: where it writes what belongs to samples; the radiance's own where None.

        Raises:
            Halted: where the render is to end.
        """
        if self._halt.is_set():
            raise Halted
        prepared = self._prepared.get(id(kernel))
        if prepared is None:
            prepared = self._prepared[id(kernel)] = self._arguments(kernel)
        words, call, address, uniforms, first = prepared
        words[0], words[1] = source.address, target.address
        if places is not None:
            words[2] = places.address
        words[3] = self.slots.address if slots is None else slots.address
        for place, name in uniforms:
            words[place] = self._uniforms[name]
        if lists is not None:
            for place, memory in zip(first, lists, strict=False):
                words[place] = memory.address
        call(address, count)

    def _arguments(self, kernel: Kernel) -> tuple[Any, Any, int, tuple[tuple[int, str], ...], range]:
        """A kernel's arguments: what is always the same is filled in, and it is said where the rest goes."""
        program = kernel.program
        start = len(HEAD) + len(program.uniforms)
        words = (ctypes.c_int64 * (start + program.lists))()
        words[_WORD["stride"]] = CAPACITY
        words[_WORD["counters"]] = self.counters.ctypes.data
        words[_WORD["tables"]] = kernel.tables.address
        if self.kernels.search is not None:
            words[_WORD["search"]] = ctypes.addressof(self.kernels.search)
        uniforms = tuple((len(HEAD) + k, name) for k, name in enumerate(program.uniforms))
        self._keep.append(kernel)  # so that its id stays its own
        return words, program.call, ctypes.addressof(words), uniforms, range(start, start + program.lists)
