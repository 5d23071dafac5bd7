"""One chunk of lanes from its camera rays to the radiance of its samples, in one thread and in memory of its own."""

from __future__ import annotations

import ctypes
import threading
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from torchpt.accel import Accel
from torchpt.integrators.loop.kernels import PLACE, Kernel, Kernels
from torchpt.integrators.loop.rows import HIT, Memory, Rows
from torchpt.integrators.path import ENDLESS, Tally
from torchpt.integrators.search import PASSES
from torchpt.lanes.block import WIDTH
from torchpt.lanes.kernel import CAPACITY, HEAD
from torchpt.records import Hit, PathState
from torchpt.samplers import salts

__all__ = ["LANES", "Chunk", "Halted", "Worker"]

#: Lanes of a chunk.
LANES = CAPACITY - WIDTH
_STATE = tuple(field.name for field in fields(PathState))
_WORD = {name: k for k, name in enumerate(HEAD)}


@dataclass(frozen=True)
class Chunk:
    """Consecutive pixels of the picture, and consecutive samples of each."""

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int


def _none(state: PathState) -> Hit:
    raise AssertionError("hits are found between stages where there is no tape")


class Halted(Exception):
    """The render is to end."""


class Worker:
    """What one thread needs: arenas, lists, slots, and the arguments of its calls.

    Args:
        kernels: of the render.
        halt: set where the render is to end; None: it never is.
    """

    def __init__(self, kernels: Kernels, halt: threading.Event | None = None) -> None:
        self.kernels, self.wave, self._halt = kernels, kernels.wave, halt or threading.Event()
        self._arenas = [Memory(kernels.state.count) for _ in range(2)]
        self._passed = [Memory(kernels.passed.count) for _ in range(2)] if kernels.has_opacity else []
        self._sifted = Memory(1)
        count = kernels.models + 2
        self._lists = [[Memory(1) for _ in range(count)] for _ in range(2)]
        self.slots = Memory(3)
        self.shown: Memory | None = None
        self._counters = np.zeros(count + 4, np.int64)
        self._place = np.zeros(len(PLACE), np.int32)
        self._calls: dict[int, tuple[Any, Any, int, tuple[tuple[int, str], ...], range]] = {}
        self._keep: list[Kernel] = []
        self._salts: dict[int, Any] = {}
        self._uniforms = {"place": self._place.ctypes.data}

    def trace(self, chunk: Chunk) -> Tally:
        """Fills ``slots`` with the radiance of a chunk's samples, ``samples`` rows of ``pixels`` one after the other."""
        self._start(chunk)
        tally = Tally()
        count = chunk.pixels * chunk.samples
        if self.wave.preview is not None:
            self._previewed(count, tally)
        elif self.kernels.fused:
            self._fused(count, tally)
        else:
            self._searched(count, tally)
        return tally

    def layers(self, chunk: Chunk, names: tuple[str, ...]) -> int:
        """Fills ``shown`` with layers of the first surfaces, channel after channel; returns how many rays it took."""
        from torchpt.integrators.aov import CHANNELS

        self._start(chunk)
        kernels, count = self.kernels, chunk.pixels * chunk.samples
        channels = sum(CHANNELS[name] for name in names)
        if self.shown is None or len(self.shown.words) != channels:
            self.shown = Memory(channels)
        self.shown.words[:, :count] = 0
        here, lists = self._arenas[0], self._lists[0]
        self._clear()
        self._name_salts(0)
        self._run(kernels.generate(), count, here, here, lists=lists)
        if not kernels.fused:
            self._nearest(here, count, 1)
            self._clear()
            self._run(kernels.settle(False), count, here, here, lists=lists)
        _, places = self._found()
        for model, lanes in enumerate(self._groups(places)):
            if lanes:
                named = lists[model] if kernels.listed else None
                self._run(kernels.layers(model, names), lanes, here, here, named, slots=self.shown)
        return count

    # -- the loop over depth

    def _previewed(self, count: int, tally: Tally) -> None:
        """The first surfaces under prefiltered maps, and other lights with their shadows."""
        kernels = self.kernels
        here, there = self._arenas
        now, then = self._lists
        self._name_salts(0)
        self._run(kernels.generate(), count, here, here)
        tally.rays += count
        self._nearest(here, count, 1)
        self._clear()
        self._run(kernels.settle(False), count, here, here, lists=now)
        _, places = self._found()
        if not self._ends(here, now, count, places, 1, tally):
            return
        self._name_salts(1)
        done = 0
        for model, lanes in enumerate(places[: kernels.models]):
            if lanes:
                self._counters[0] = done
                kernel = kernels.preview(model)
                self._run(kernel, lanes, here, there, now[model])
                tally.rays += lanes * kernel.program.shadows
                done += lanes
        shadow = "shadow_o" in kernels.state
        if shadow:
            self._light(there, done)
        _row(there.words, kernels.state, "prim", 1)[0][:done] = -1
        self._clear()
        self._run(kernels.settle(shadow), done, there, there, lists=then)

    def _start(self, chunk: Chunk) -> None:
        wave, sampler = self.wave, self.wave.sampler
        x, y, width, _ = wave.crop
        group, point = chunk.first_sample % sampler.randomizations, chunk.first_sample // sampler.randomizations
        self._place[:] = np.array(
            (
                chunk.first_pixel, chunk.pixels, group, (point + (1 << 31)) % (1 << 32) - (1 << 31),
                sampler.randomizations, x, y, width, wave.camera.resolution[0],
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
            tally.rays += self._bounced(places)
            self._clear()
            tally.rays += self._bounce(here, there, now, then, places, depth)
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
            tally.rays += self._bounce(here, there, now, then, places, depth)
            shadow = "shadow_o" in kernels.state
            if shadow:
                self._light(there, count)
            here, there, now, then = there, here, then, now
            depth += 1

    def _ends(self, here: Memory, lists: list[Memory], live: int, places: list[int], depth: int, tally: Tally) -> bool:
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
        self, here: Memory, there: Memory, now: list[Memory], then: list[Memory], places: list[int], depth: int
    ) -> int:
        """One vertex of all paths, which are together in the other arena then; returns how many shadow rays they ask for."""
        kernels, limits = self.kernels, self.wave.limits
        assert limits is not None
        self._name_salts(depth)
        done = shadows = 0
        groups = [self._live] if not kernels.listed else places[: kernels.models]
        for model, count in enumerate(groups):
            if not count:
                continue
            if not kernels.fused:
                self._counters[0] = done
            roulette = limits.roulette(depth)
            if model in kernels.eager:
                shadows += self._bounce_eagerly(model, roulette, here, there, now[model], count, done, depth)
            else:
                kernel = kernels.bounce(model, roulette)
                self._run(kernel, count, here, there, now[model] if kernels.listed else None, lists=then)
                shadows += count * kernel.program.shadows
            done += count
        return shadows

    def _bounce_eagerly(
        self,
        model: int,
        roulette: float,
        here: Memory,
        there: Memory,
        places: Memory,
        count: int,
        done: int,
        depth: int,
    ) -> int:
        """The same by tensor operations, for a model that no kernel can be made of."""
        rows = self.kernels.state
        lanes = places.words[0, :count]
        with torch.no_grad():
            state = PathState(**{"eta": None, "p": None, "n": None, **rows.take(here, lanes, _STATE)})  # type: ignore[arg-type]
            hit = Hit(**rows.take(here, lanes, tuple(HIT)))
            after, _, shadow = self.wave.stages.bounce(
                model, roulette, False, _none, state, hit, torch.arange(count), salts(depth, torch.device("cpu"))
            )
        values = {name: getattr(after, name) for name in _STATE}
        values |= rows.take(here, lanes, ("weight",))
        if "shadow_o" in rows:
            light = torch.zeros_like(after.o) if shadow is None else shadow.radiance
            values |= {
                "shadow_o": after.o if shadow is None else shadow.o,
                "shadow_d": after.d if shadow is None else shadow.d,
                "shadow_t": torch.zeros_like(after.t_max) if shadow is None else shadow.t_max,
                "shadow_radiance": light,
            }
        rows.put(there, done, values)
        return 0 if shadow is None else count

    # -- the search

    def _nearest(self, here: Memory, count: int, depth: int) -> None:
        rows = self.kernels.state
        self._search(here, rows, "o", "d", "t_max", count)
        if not self.kernels.has_opacity:
            return
        self._name_salts(depth)
        self._clear()
        self._run(self.kernels.sift(), count, here, here, lists=[self._sifted])
        some = int(self._counters[0])
        if not some:
            return
        source, target = self._passed
        self._clear()
        self._run(self.kernels.meet(False), some, here, source, self._sifted)
        step = 0
        while left := int(self._counters[0]):
            step += 1
            self._search(source, self.kernels.passed, "pass_o", "pass_d", "pass_t", left)
            self._name_salts(depth + step * PASSES)
            self._clear()
            self._run(self.kernels.meet(True), left, source, target, slots=here)
            source, target = target, source

    def _light(self, there: Memory, count: int) -> None:
        """How much of the light of shadow rays arrives."""
        kernels, rows = self.kernels, self.kernels.state
        if not kernels.packets:
            o, d, t_max = (_row(there.floats, rows, f"shadow_{name}", n) for name, n in (("o", 3), ("d", 3), ("t", 1)))
            blocked = _row(there.words, rows, "blocked", 1)[0]
            self.wave.accel.blocked(o, d, t_max[0], count, blocked, kernels.non_opaque)
        elif not kernels.has_opacity:
            self._run(kernels.block(), count, there, there)
        if not kernels.has_opacity:
            return
        source, target = self._passed
        self._clear()
        self._run(kernels.begin(), count, there, source, slots=there)
        while left := int(self._counters[0]):
            self._search(source, self.kernels.passed, "pass_o", "pass_d", "pass_t", left)
            self._clear()
            self._run(self.kernels.through(), left, source, target, slots=there)
            source, target = target, source

    def _search(self, memory: Memory, rows: Rows, o: str, d: str, t_max: str, count: int) -> None:
        if self.kernels.packets:
            self._run(self.kernels.find(rows is self.kernels.passed), count, memory, memory)
            return
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
        source: Memory,
        target: Memory,
        places: Memory | None = None,
        lists: list[Memory] | None = None,
        slots: Memory | None = None,
    ) -> None:
        if self._halt.is_set():
            raise Halted
        prepared = self._calls.get(id(kernel))
        if prepared is None:
            prepared = self._calls[id(kernel)] = self._prepared(kernel)
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

    def _prepared(self, kernel: Kernel) -> tuple[Any, Any, int, tuple[tuple[int, str], ...], range]:
        """A kernel's arguments: what is always the same is filled in, and it is said where the rest goes."""
        program = kernel.program
        start = len(HEAD) + len(program.uniforms)
        words = (ctypes.c_int64 * (start + program.lists))()
        words[_WORD["stride"]] = CAPACITY
        words[_WORD["counters"]] = self._counters.ctypes.data
        words[_WORD["tables"]] = kernel.tables.address
        if self.kernels.search is not None:
            words[_WORD["search"]] = ctypes.addressof(self.kernels.search)
        uniforms = tuple((len(HEAD) + k, name) for k, name in enumerate(program.uniforms))
        self._keep.append(kernel)  # so that its id stays its own
        return words, program.call, ctypes.addressof(words), uniforms, range(start, start + program.lists)


def _row(memory: np.ndarray, rows: Rows, name: str, count: int) -> np.ndarray:
    first = rows.first(name)
    return memory[first : first + count]
