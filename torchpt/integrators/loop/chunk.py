"""One chunk of lanes from its camera rays to the radiance of its samples, in one thread and in memory of its own."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchpt.accel import Accel
from torchpt.integrators.loop.kernels import PLACE, Kernel, Kernels
from torchpt.integrators.loop.rows import Rows
from torchpt.integrators.path import ENDLESS, Tally
from torchpt.integrators.search import PASSES
from torchpt.lanes.block import WIDTH
from torchpt.lanes.kernel import CAPACITY, HEAD
from torchpt.samplers import salts

__all__ = ["LANES", "Chunk", "Worker"]

#: Lanes of a chunk.
LANES = CAPACITY - WIDTH
_WORD = {name: k for k, name in enumerate(HEAD)}


@dataclass(frozen=True)
class Chunk:
    """Consecutive pixels of the picture, and consecutive samples of each."""

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int


class _Memory:
    """Rows of 32-bit words, each with some to spare: kernels write whole vectors."""

    def __init__(self, rows: int, columns: int = CAPACITY) -> None:
        self.words = np.zeros((rows, columns), np.int32)
        self.floats = self.words.view(np.float32)
        self.address = self.words.ctypes.data


class Worker:
    """What one thread needs: arenas, lists, slots, and the arguments of its calls.

    Args:
        kernels: of the render.
    """

    def __init__(self, kernels: Kernels) -> None:
        self.kernels, self.wave = kernels, kernels.wave
        self._arenas = [_Memory(kernels.state.count) for _ in range(2)]
        self._passed = [_Memory(kernels.passed.count) for _ in range(2)] if kernels.veiled else []
        count = kernels.models + 2
        self._lists = [[_Memory(1) for _ in range(count)] for _ in range(2)]
        self.slots = _Memory(3)
        self._counters = np.zeros(count + 4, np.int64)
        self._place = np.zeros(len(PLACE), np.int32)
        self._calls: dict[int, tuple[Any, Any, int]] = {}
        self._salts: dict[int, Any] = {}
        self._uniforms = {"place": self._place.ctypes.data}

    def trace(self, chunk: Chunk) -> Tally:
        """Fills ``slots`` with the radiance of a chunk's samples, ``samples`` rows of ``pixels`` one after the other."""
        self._start(chunk)
        tally = Tally()
        count = chunk.pixels * chunk.samples
        if self.kernels.fused:
            self._fused(count, tally)
        else:
            self._searched(count, tally)
        return tally

    # -- the loop over depth

    def _start(self, chunk: Chunk) -> None:
        wave, sampler = self.wave, self.wave.sampler
        x, y, width, _ = wave.crop
        group, point = chunk.first_sample % sampler.randomizations, chunk.first_sample // sampler.randomizations
        self._place[:] = np.array(
            (
                chunk.first_pixel, chunk.pixels, group, (point + (1 << 31)) % (1 << 32) - (1 << 31),
                sampler.randomizations, x, y, width, wave.camera.width,
            ),
            np.int64,
        ).astype(np.int32)  # fmt: skip

    def _fused(self, count: int, tally: Tally) -> None:
        kernels = self.kernels
        here, there = self._arenas
        now, then = self._lists
        self._clear()
        self._name_salts(0)
        self._run(kernels.generate(), count, here, here, lists=now)
        tally.rays += count
        depth = 1
        while True:
            live, places = self._found()
            if not self._ends(here, now, live, places, depth, tally):
                return
            tally.rays += self._bounced(places) * (2 if self.wave.stages.world.lights is not None else 1)
            self._clear()
            self._bounce(here, there, now, then, places, depth)
            here, there, now, then = there, here, then, now
            depth += 1

    def _searched(self, count: int, tally: Tally) -> None:
        kernels = self.kernels
        here, there = self._arenas
        now, then = self._lists
        self._name_salts(0)
        self._run(kernels.generate(), count, here, here)
        depth, shadow = 1, False
        while count:
            tally.rays += count
            self._nearest(here, count, depth)
            self._clear()
            self._run(kernels.settle(shadow), count, here, here, lists=now)
            _, places = self._found()
            if not self._ends(here, now, count, places, depth, tally):
                return
            self._clear()
            count = self._bounced(places)
            self._bounce(here, there, now, then, places, depth)
            shadow = "shadow_o" in kernels.state
            if shadow:
                tally.rays += count
                self._light(there, count)
            here, there, now, then = there, here, then, now
            depth += 1

    def _ends(
        self, here: _Memory, lists: list[_Memory], live: int, places: list[int], depth: int, tally: Tally
    ) -> bool:
        """Gathers light where lanes met it, and ends paths; returns whether any go on."""
        kernels, limits = self.kernels, self.wave.limits
        assert limits is not None
        last = limits.max_depth if limits.max_depth >= 0 else ENDLESS
        if kernels.emitters and places[kernels.emissive]:
            self._run(kernels.emit(), places[kernels.emissive], here, here, lists[kernels.emissive])
        if kernels.around and places[kernels.missed]:
            self._run(kernels.escape(), places[kernels.missed], here, here, lists[kernels.missed])
        if depth < last:
            return bool(self._bounced(places))
        for number, count in enumerate(self._groups(places)):
            if count:
                self._run(kernels.retire(), count, here, here, lists[number] if kernels.listed else None)
                tally.truncated += count if limits.max_depth < 0 else 0
        return False

    def _groups(self, places: list[int]) -> list[int]:
        """How many lanes each model has."""
        return places[: self.kernels.models] if self.kernels.listed else [int(self._counters[0])]

    def _bounced(self, places: list[int]) -> int:
        return sum(self._groups(places))

    def _bounce(
        self, here: _Memory, there: _Memory, now: list[_Memory], then: list[_Memory], places: list[int], depth: int
    ) -> None:
        """One vertex of all paths; those that go on are together in the other arena."""
        kernels, limits = self.kernels, self.wave.limits
        assert limits is not None
        self._name_salts(depth)
        done = 0
        groups = [self._live] if not kernels.listed else places[: kernels.models]
        for model, count in enumerate(groups):
            if not count:
                continue
            if not kernels.fused:
                self._counters[0] = done
            kernel = kernels.bounce(model, depth >= limits.rr_depth)
            self._run(kernel, count, here, there, now[model] if kernels.listed else None, lists=then)
            done += count

    # -- the search

    def _nearest(self, here: _Memory, count: int, depth: int) -> None:
        rows = self.kernels.state
        self._search(here, rows, "o", "d", "t_max", count)
        if not self.kernels.veiled:
            return
        self._name_salts(depth)
        source, target = self._passed
        self._clear()
        self._run(self.kernels.meet(False), count, here, source)
        step = 0
        while left := int(self._counters[0]):
            step += 1
            self._search(source, self.kernels.passed, "pass_o", "pass_d", "pass_t", left)
            self._name_salts(depth + step * PASSES)
            self._clear()
            self._run(self.kernels.meet(True), left, source, target, slots=here)
            source, target = target, source

    def _light(self, there: _Memory, count: int) -> None:
        """How much of the light of shadow rays arrives."""
        rows = self.kernels.state
        if not self.kernels.veiled:
            o, d, t_max = (_row(there.floats, rows, f"shadow_{name}", n) for name, n in (("o", 3), ("d", 3), ("t", 1)))
            self.wave.accel.blocked(o, d, t_max[0], count, _row(there.words, rows, "blocked", 1)[0])
            return
        source, target = self._passed
        self._clear()
        self._run(self.kernels.begin(), count, there, source)
        while left := int(self._counters[0]):
            self._search(source, self.kernels.passed, "pass_o", "pass_d", "pass_t", left)
            self._clear()
            self._run(self.kernels.through(), left, source, target, slots=there)
            source, target = target, source

    def _search(self, memory: _Memory, rows: Rows, o: str, d: str, t_max: str, count: int) -> None:
        accel: Accel = self.wave.accel
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

    # -- calls

    def _clear(self) -> None:
        self._counters[:] = 0

    def _found(self) -> tuple[int, list[int]]:
        """How many lanes are in the arena, and how many places in each list."""
        self._live = int(self._counters[0])
        return self._live, self._counters[1 : self.kernels.models + 3].tolist()

    def _name_salts(self, depth: int) -> None:
        known = self._salts.get(depth)
        if known is None:
            known = self._salts[depth] = salts(depth, torch.device("cpu")).contiguous()
        self._uniforms["salts"] = known.data_ptr()

    def _run(
        self,
        kernel: Kernel,
        count: int,
        source: _Memory,
        target: _Memory,
        places: _Memory | None = None,
        lists: list[_Memory] | None = None,
        slots: _Memory | None = None,
    ) -> None:
        prepared = self._calls.get(id(kernel))
        if prepared is None:
            words = (ctypes.c_int64 * (len(HEAD) + len(kernel.uniforms) + kernel.lists))()
            words[_WORD["counters"]] = self._counters.ctypes.data
            words[_WORD["tables"]] = kernel.tables.address
            if self.kernels.search is not None:
                words[_WORD["search"]] = ctypes.addressof(self.kernels.search)
            prepared = self._calls[id(kernel)] = words, kernel, ctypes.addressof(words)
        words, _, address = prepared
        words[0], words[1] = source.address, target.address
        if places is not None:
            words[2] = places.address
        out = self.slots if slots is None else slots
        words[3], words[4] = out.address, out.words.shape[1]
        for k, name in enumerate(kernel.uniforms):
            words[len(HEAD) + k] = self._uniforms[name]
        if lists is not None:
            for k in range(kernel.lists):
                words[len(HEAD) + len(kernel.uniforms) + k] = lists[k].address
        kernel.call(address, count)


def _row(memory: np.ndarray, rows: Rows, name: str, count: int) -> np.ndarray:
    first = rows.first(name)
    return memory[first : first + count]
