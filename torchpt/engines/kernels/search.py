"""What the rays of a chunk meet, where that is asked between stages: by packets, or by the search structure.

Surfaces that are not opaque let rays pass by chance and shadow rays in part: such rays move to an arena of their own and are
searched again from behind the surface, until each is stopped or has met nothing.
"""

from __future__ import annotations

import numpy as np

from torchpt.accel import Accel
from torchpt.engines.kernels.calls import Calls
from torchpt.engines.kernels.rows import Memory, Rows

__all__ = ["ChunkSearch"]


class ChunkSearch:
    """The search of one thread's chunks.

    Args:
        calls: of the thread.
    """

    def __init__(self, calls: Calls) -> None:
        self.calls, self.kernels = calls, calls.kernels
        self.passed = [Memory(self.kernels.passed.count) for _ in range(2)] if self.kernels.passing else []
        self.sifted = Memory(1)

    def nearest(self, arena: Memory, count: int) -> None:
        """Write the hits of the arena's rays beside them: the nearest surfaces, opaque or not."""
        self._trace(arena, self.kernels.state, "o", "d", "t_max", count)

    def transmit(self, arena: Memory, count: int, depth: int, step: int) -> int:
        """Take a step through what lets rays pass.

        Args:
            arena: of the paths; hits of rays that are held up are written there.
            count: how many paths there are, at the first step; then how many rays are on their way.
            depth: of the vertex that they come to.
            step: of the rays, from 0.

        Returns:
            How many rays are still on their way.
        """
        kernels, calls = self.kernels, self.calls
        calls.name_salts(depth, step)
        source, target = self.passed[step % 2], self.passed[1 - step % 2]
        if step == 0:
            calls.clear()
            calls.run(kernels.sift(), count, arena, arena, lists=[self.sifted])
            some = int(calls.counters[0])
            if not some:
                return 0
            calls.clear()
            calls.run(kernels.transmit(False), some, arena, target, self.sifted, slots=arena)
        else:
            calls.clear()
            calls.run(kernels.transmit(True), count, source, target, slots=arena)
        left = int(calls.counters[0])
        if left:
            self._trace(target, kernels.passed, "pass_o", "pass_d", "pass_t", left)
        return left

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
