"""One chunk of lanes from its camera rays to the radiance of its samples, in one thread and in memory of its own.

A chunk is some thousand samples, one path a lane. Paths lie in an *arena* (:mod:`~torchpt.integrators.loop.rows`); a vertex
takes them from one arena to the other, without those that ended. Where the search is inside of the stages (``fused``)::

    generate   camera rays and their first hits; lanes listed by what they met
    emit       light of the lanes that met an emitter: list `emissive`
    escape     light of the lanes that met nothing, and their ends: list `missed`
    bounce     one kernel a BSDF model, on the lanes of its list: light sample, shadow ray, BSDF sample, roulette, next hit;
               lanes that go on are packed in the other arena and listed
               ... from `emit` on again, until none is left or paths are long enough; then
    retire     ends of the paths that are cut

Else searches come between stages: ``generate``, then each vertex is *search* (:mod:`~torchpt.integrators.loop.search`),
``settle`` (adds the light of the last shadow rays, lists lanes, ends paths), ``emit``, ``escape``, ``bounce``, *search of
shadow rays*.

A path that ends writes its radiance to the slot of its sample; :mod:`~torchpt.integrators.loop.schedule` adds slots to the
film. :mod:`~torchpt.integrators.loop.kernels` says how a kernel is added.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from torchpt.integrators import LAYERS
from torchpt.integrators.loop.calls import Calls
from torchpt.integrators.loop.eager import bounce_eagerly
from torchpt.integrators.loop.kernels import Kernels
from torchpt.integrators.loop.rows import Memory
from torchpt.integrators.loop.search import ChunkSearch
from torchpt.integrators.path import ENDLESS
from torchpt.integrators.plate import Plate
from torchpt.integrators.tally import Tally
from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.form import VECTORS

__all__ = ["LANES", "Chunk", "Worker"]

#: Lanes of a chunk.
LANES = CAPACITY - VECTORS.width


@dataclass(frozen=True)
class Chunk:
    """Consecutive pixels of a plate (None: of the picture), and consecutive samples of each."""

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int
    plate: Plate | None = None


class Worker:
    """What one thread needs to take chunks through their paths.

    Args:
        kernels: of the render.
        halt: set where the render is to end; None: it never is.

    Attributes:
        slots: radiance of the chunk's samples.
        shown: layers of the chunk's samples, once they were asked for.
    """

    def __init__(self, kernels: Kernels, halt: threading.Event | None = None) -> None:
        self.kernels, self.wave = kernels, kernels.wave
        self.calls = Calls(kernels, halt or threading.Event())
        self.search = ChunkSearch(self.calls)
        self.slots = self.calls.slots
        self.shown: Memory | None = None
        self._arenas = [Memory(kernels.state.count) for _ in range(2)]
        self._lists = [[Memory(1) for _ in range(kernels.models + 2)] for _ in range(2)]

    def serve(self, kernels: Kernels, halt: threading.Event) -> None:
        """Go on with another render of the same structure: fresh memory would cost time."""
        self.kernels, self.wave = kernels, kernels.wave
        self.calls.serve(kernels, halt)
        self.search.kernels = kernels

    def trace(self, chunk: Chunk) -> Tally:
        """Fills ``slots`` with the radiance of a chunk's samples, ``samples`` rows of ``pixels`` one after the other."""
        self.start(chunk)
        tally = Tally()
        count = chunk.pixels * chunk.samples
        if self.wave.first is not None:
            self._first_surfaces(chunk, count, tally)
        elif self.kernels.fused:
            self._fused(chunk, count, tally)
        else:
            self._searched(chunk, count, tally)
        return tally

    def layers(self, chunk: Chunk, names: tuple[str, ...]) -> int:
        """Fills ``shown`` with layers of the first surfaces, channel after channel; returns how many rays it took."""
        self.start(chunk)
        kernels, calls, count = self.kernels, self.calls, chunk.pixels * chunk.samples
        channels = sum(len(LAYERS[name].channels) for name in names)
        if self.shown is None or len(self.shown.words) != channels:
            self.shown = Memory(channels)
        self.shown.words[:, :count] = 0
        arena, other = self._arenas
        lists = self._lists[0]
        calls.clear()
        calls.name_salts(0)
        self._generate(chunk, arena, other, lists)
        if not kernels.fused:
            self.search.nearest(arena, count, 1)
            calls.clear()
            calls.run(kernels.settle(False), count, arena, arena, lists=lists)
        groups, _ = self._listed()
        for model, lanes in enumerate(groups):
            if lanes:
                places = lists[model] if kernels.listed else None
                calls.run(kernels.layers(model, names), lanes, arena, arena, places, slots=self.shown)
        return count

    def start(self, chunk: Chunk) -> None:
        """Say which samples are next."""
        wave, plate = self.wave, chunk.plate
        streams = wave.sampler.streams if plate is None else plate.streams
        x, y, width, _ = wave.crop
        point, turn = divmod(chunk.first_sample, streams.count)
        self.calls.place[:] = np.array(
            (
                chunk.first_pixel, chunk.pixels, turn, (point + (1 << 31)) % (1 << 32) - (1 << 31),
                streams.first, streams.count, x, y, width, wave.camera.resolution[0],
            ),
            np.int64,
        ).astype(np.int32)  # fmt: skip

    def _generate(self, chunk: Chunk, arena: Memory, other: Memory, lists: list[Memory] | None = None) -> None:
        """Camera rays of a chunk in ``arena``; ``other`` holds the numbers of chosen pixels until then."""
        count, places = chunk.pixels * chunk.samples, None if chunk.plate is None else chunk.plate.places
        source = arena
        if places is not None:
            chosen = places[chunk.first_pixel : chunk.first_pixel + chunk.pixels].numpy().astype(np.int32)
            other.words[self.kernels.state.first("prim"), :count] = np.tile(chosen, chunk.samples)
            source = other
        self.calls.run(self.kernels.generate(places is not None), count, source, arena, lists=lists)

    # -- the three loops

    def _fused(self, chunk: Chunk, count: int, tally: Tally) -> None:
        """Paths whose stages search by themselves."""
        calls = self.calls
        arena, other = self._arenas
        lists, next_lists = self._lists
        calls.clear()
        calls.name_salts(0)
        self._generate(chunk, arena, other, lists)
        tally.rays += count
        depth = 1
        while True:
            groups, places = self._listed()
            if not self._met_light(arena, lists, groups, places, depth, tally):
                return
            tally.rays += sum(groups)
            calls.clear()
            tally.rays += self._bounce(arena, other, lists, next_lists, groups, depth)
            arena, other, lists, next_lists = other, arena, next_lists, lists
            depth += 1

    def _searched(self, chunk: Chunk, count: int, tally: Tally) -> None:
        """Paths whose rays are searched between stages."""
        kernels, calls = self.kernels, self.calls
        arena, other = self._arenas
        lists, next_lists = self._lists
        calls.name_salts(0)
        self._generate(chunk, arena, other)
        depth, shadow = 1, False
        while count:
            tally.rays += count
            self.search.nearest(arena, count, depth)
            calls.clear()
            calls.run(kernels.settle(shadow), count, arena, arena, lists=lists)
            groups, places = self._listed()
            if not self._met_light(arena, lists, groups, places, depth, tally):
                return
            calls.clear()
            count = sum(groups)
            tally.rays += self._bounce(arena, other, lists, next_lists, groups, depth)
            shadow = "shadow_o" in kernels.state
            if shadow:
                self.search.light(other, count)
            arena, other, lists, next_lists = other, arena, next_lists, lists
            depth += 1

    def _first_surfaces(self, chunk: Chunk, count: int, tally: Tally) -> None:
        """The first surfaces, with the shadow rays that they ask for, and no further."""
        kernels, calls = self.kernels, self.calls
        arena, other = self._arenas
        lists, next_lists = self._lists
        calls.name_salts(0)
        self._generate(chunk, arena, other)
        tally.rays += count
        self.search.nearest(arena, count, 1)
        calls.clear()
        calls.run(kernels.settle(False), count, arena, arena, lists=lists)
        groups, places = self._listed()
        if not self._met_light(arena, lists, groups, places, 1, tally):
            return
        calls.name_salts(1)
        done = 0
        for model, lanes in enumerate(groups):
            if lanes:
                calls.counters[0] = done
                kernel = kernels.first(model)
                calls.run(kernel, lanes, arena, other, lists[model])
                tally.rays += lanes * kernel.program.shadows
                done += lanes
        shadow = "shadow_o" in kernels.state
        if shadow:
            self.search.light(other, done)
        other.words[kernels.state.first("prim"), :done] = -1
        calls.clear()
        calls.run(kernels.settle(shadow), done, other, other, lists=next_lists)

    # -- one vertex

    def _listed(self) -> tuple[list[int], list[int]]:
        """How many lanes each model has, and how many are in each list."""
        live, places = self.calls.counted()
        return places[: self.kernels.models] if self.kernels.listed else [live], places

    def _met_light(
        self, arena: Memory, lists: list[Memory], groups: list[int], places: list[int], depth: int, tally: Tally
    ) -> bool:
        """Gathers light where lanes met it, and ends paths that are long enough; returns whether any go on."""
        kernels, calls, limits = self.kernels, self.calls, self.wave.limits
        assert limits is not None
        last = limits.max_depth if limits.max_depth >= 0 else ENDLESS
        if kernels.has_emitters and places[kernels.emissive]:
            calls.run(kernels.emit(), places[kernels.emissive], arena, arena, lists[kernels.emissive])
        if kernels.has_environment and places[kernels.missed]:
            calls.run(kernels.escape(), places[kernels.missed], arena, arena, lists[kernels.missed])
        if depth < last:
            return any(groups)
        for model, count in enumerate(groups):
            if count:
                calls.run(kernels.retire(), count, arena, arena, lists[model] if kernels.listed else None)
                tally.truncated += count if limits.max_depth < 0 else 0
        return False

    def _bounce(
        self,
        arena: Memory,
        other: Memory,
        lists: list[Memory],
        next_lists: list[Memory],
        groups: list[int],
        depth: int,
    ) -> int:
        """One vertex of all paths, which are together in the other arena then; returns how many shadow rays they ask for."""
        kernels, calls, limits = self.kernels, self.calls, self.wave.limits
        assert limits is not None
        calls.name_salts(depth)
        roulette = limits.roulette(depth)
        done = shadows = 0
        for model, count in enumerate(groups):
            if not count:
                continue
            if not kernels.fused:
                calls.counters[0] = done
            if model in kernels.eager:
                shadows += bounce_eagerly(kernels, model, roulette, arena, other, lists[model], count, done, depth)
            else:
                kernel = kernels.bounce(model, roulette)
                places = lists[model] if kernels.listed else None
                calls.run(kernel, count, arena, other, places, lists=next_lists)
                shadows += count * kernel.program.shadows
            done += count
        return shadows
