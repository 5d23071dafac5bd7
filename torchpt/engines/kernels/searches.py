"""Searches between stages: by packet kernels, or by the acceleration structure.

Rays that hit surfaces that are not opaque move to an arena of their own and are searched again from behind the surface, until
each is stopped or hits nothing.
"""

from __future__ import annotations

import numpy as np

from torchpt.engines.kernels.calls import Calls, LaneCount
from torchpt.engines.kernels.layout import Memory, Rows
from torchpt.engines.kernels.programs import Kernels
from torchpt.search.base import Search

__all__ = ["ChunkSearch"]


class ChunkSearch:
    """Searches the rays of one thread's chunks.

    Args:
        calls: of the thread.

    Attributes:
        passed: two arenas for rays in transit, which move from one to the other; none if rays pass nothing.
        transmitting: list of the lanes that the stage ``transmit`` runs for.
    """

    def __init__(self, calls: Calls) -> None:
        self.calls, self.kernels = calls, calls.kernels
        self._bound: dict[tuple[int, str], Search] = {}  # searches in memory, by its address and the rays in it
        arenas = 2 if self.kernels.has_transmission else 0
        self.passed = [calls.memory(self.kernels.passed.count) for _ in range(arenas)]
        self.transmitting = calls.memory(1)

    def unbind(self) -> None:
        """Drop all references to the render."""
        del self.kernels
        self._bound.clear()

    def rebind(self, kernels: Kernels) -> None:
        """Search for another render of the same structure, after :meth:`unbind`."""
        self.kernels = kernels

    def nearest(self, arena: Memory, count: LaneCount) -> None:
        """Find the nearest hits, opaque or not, of the arena's rays, and write them to the arena."""
        self._trace(arena, self.kernels.state, "o", "d", "t_max", count)

    def transmit(self, arena: Memory, count: LaneCount, depth: int, step: int) -> LaneCount:
        """Take one step through surfaces or media that rays may pass.

        Args:
            arena: of the paths; hits of rays that stop are written to it.
            count: number of paths at step 0; then number of rays in transit.
            depth: number of the vertex that the rays come to.
            step: from 0.

        Returns:
            The number of rays still in transit.
        """
        kernels, calls = self.kernels, self.calls
        calls.set_dimensions(depth, step)
        source, target = self.passed[step % 2], self.passed[1 - step % 2]
        if step == 0:
            calls.clear()
            calls.run(kernels.list_transmitting(), count, arena, arena, lists=[self.transmitting])
            transmitting = calls.left(0)
            if not transmitting:
                return 0
            calls.clear()
            calls.run(kernels.transmit(again=False), transmitting, arena, target, self.transmitting, slots=arena)
        else:
            calls.clear()
            calls.run(kernels.transmit(again=True), count, source, target, slots=arena)
        left = calls.left(step + 1)
        if left:
            self._trace(target, kernels.passed, "pass_o", "pass_d", "pass_t", left)
        return left

    def light(self, arena: Memory, count: LaneCount) -> None:
        """Trace the arena's shadow rays, and write to it whether they are blocked, or their transmittance."""
        kernels, calls = self.kernels, self.calls
        if not kernels.by_kernels:
            self._occluded_outside(arena, count)
        elif not kernels.has_opacity:
            calls.run(kernels.search_occluded(), count, arena, arena)
        if not kernels.has_opacity:
            return
        source, target = self.passed
        calls.clear()
        calls.run(kernels.begin_shadow_rays(), count, arena, source, slots=arena)
        step = 0
        while left := calls.left(step):
            self._trace(source, kernels.passed, "pass_o", "pass_d", "pass_t", left)
            calls.clear()
            calls.run(kernels.attenuate_shadow_rays(), left, source, target, slots=arena)
            source, target = target, source
            step += 1

    def _trace(self, memory: Memory, rows: Rows, o: str, d: str, t_max: str, count: LaneCount) -> None:
        """Find the nearest hit, opaque or not, of each ray in the rows ``o, d, t_max``."""
        if self.kernels.by_kernels:
            kernel = self.kernels.search_nearest(passed=rows is self.kernels.passed)
            self.calls.run(kernel, count, memory, memory)
        else:
            self._nearest_outside(memory, rows, o, d, t_max, count)

    # -- searches by the acceleration structure, outside of kernels

    def _nearest_outside(self, memory: Memory, rows: Rows, o: str, d: str, t_max: str, count: LaneCount) -> None:
        key = memory.address, o
        search = self._bound.get(key)
        if search is None:
            floats, words = memory.floats, memory.words
            search = self._bound[key] = self.kernels.wave.accel.nearest_in(
                _row(floats, rows, o, 3),
                _row(floats, rows, d, 3),
                _row(floats, rows, t_max, 1)[0],
                _row(floats, rows, "t", 1)[0],
                _row(words, rows, "prim", 1)[0],
                _row(floats, rows, "u", 1)[0],
                _row(floats, rows, "v", 1)[0],
            )
        search(count)

    def _occluded_outside(self, arena: Memory, count: LaneCount) -> None:
        key = arena.address, "shadow_o"
        search = self._bound.get(key)
        if search is None:
            kernels, rows = self.kernels, self.kernels.state
            o, d, t_max = (_row(arena.floats, rows, f"shadow_{name}", n) for name, n in (("o", 3), ("d", 3), ("t", 1)))
            blocked = _row(arena.words, rows, "blocked", 1)[0]
            search = self._bound[key] = kernels.wave.accel.blocked_in(o, d, t_max[0], blocked, kernels.non_opaque)
        search(count)


def _row(memory: np.ndarray, rows: Rows, name: str, count: int) -> np.ndarray:
    """Return the ``count`` rows of a field."""
    first = rows.first(name)
    return memory[first : first + count]
