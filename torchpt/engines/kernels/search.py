"""What the rays of a chunk meet, where that is asked between stages: by packets, or by the search structure.

Surfaces that are not opaque let rays pass by chance and shadow rays in part: such rays move to an arena of their own and are
searched again from behind the surface, until each is stopped or has met nothing.
"""

from __future__ import annotations

import numpy as np

from torchpt.accel import Accel
from torchpt.engines.kernels.calls import Calls
from torchpt.engines.kernels.rows import Memory, Rows
from torchpt.integrators.search import PASSES

__all__ = ["ChunkSearch"]


class ChunkSearch:
    """The search of one thread's chunks.

    Args:
        calls: of the thread.
    """

    def __init__(self, calls: Calls) -> None:
        self.calls, self.kernels = calls, calls.kernels
        self.passed = [Memory(self.kernels.passed.count) for _ in range(2)] if self.kernels.has_opacity else []
        self.sifted = Memory(1)

    def nearest(self, arena: Memory, count: int, depth: int) -> None:
        """Write the hits of the arena's rays beside them."""
        kernels, calls = self.kernels, self.calls
        self._trace(arena, kernels.state, "o", "d", "t_max", count)
        if not kernels.has_opacity:
            return
        calls.name_salts(depth)
        calls.clear()
        calls.run(kernels.sift(), count, arena, arena, lists=[self.sifted])
        some = int(calls.counters[0])
        if not some:
            return
        source, target = self.passed
        calls.clear()
        calls.run(kernels.meet(False), some, arena, source, self.sifted)
        step = 0
        while left := int(calls.counters[0]):
            step += 1
            self._trace(source, kernels.passed, "pass_o", "pass_d", "pass_t", left)
            calls.name_salts(depth + step * PASSES)
            calls.clear()
            calls.run(kernels.meet(True), left, source, target, slots=arena)
            source, target = target, source

    def light(self, arena: Memory, count: int) -> None:
        """Write how much of the light of the arena's shadow rays arrives."""
        kernels, calls, rows = self.kernels, self.calls, self.kernels.state
        if not kernels.packets:
            o, d, t_max = (_row(arena.floats, rows, f"shadow_{name}", n) for name, n in (("o", 3), ("d", 3), ("t", 1)))
            blocked = _row(arena.words, rows, "blocked", 1)[0]
            kernels.wave.accel.blocked(o, d, t_max[0], count, blocked, kernels.non_opaque)
        elif not kernels.has_opacity:
            calls.run(kernels.block(), count, arena, arena)
        if not kernels.has_opacity:
            return
        source, target = self.passed
        calls.clear()
        calls.run(kernels.begin(), count, arena, source, slots=arena)
        while left := int(calls.counters[0]):
            self._trace(source, kernels.passed, "pass_o", "pass_d", "pass_t", left)
            calls.clear()
            calls.run(kernels.through(), left, source, target, slots=arena)
            source, target = target, source

    def _trace(self, memory: Memory, rows: Rows, o: str, d: str, t_max: str, count: int) -> None:
        """The nearest surface of each ray, opaque or not."""
        if self.kernels.packets:
            self.calls.run(self.kernels.find(rows is self.kernels.passed), count, memory, memory)
            return
        accel: Accel = self.kernels.wave.accel
        floats, words = memory.floats, memory.words
        accel.nearest(
            _row(floats, rows, o, 3),
            _row(floats, rows, d, 3),
            _row(floats, rows, t_max, 1)[0],
            count,
            _row(floats, rows, "t", 1)[0],
            _row(words, rows, "prim", 1)[0],
            _row(floats, rows, "u", 1)[0],
            _row(floats, rows, "v", 1)[0],
        )


def _row(memory: np.ndarray, rows: Rows, name: str, count: int) -> np.ndarray:
    first = rows.first(name)
    return memory[first : first + count]
