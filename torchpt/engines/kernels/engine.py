"""The engine of kernels: the stages of a walk on a chunk of lanes, in memory of its own.

A chunk is some thousand samples, one path a lane. The path state is stored in an *arena*
(:mod:`~torchpt.engines.kernels.layout`); `scatter` moves the paths that go on from one arena to the other. Where the search is
part of the stages (``fused``), paths arrive with their hits and lists of lanes: `intersect` and `occlude` do nothing, and
`sort` reads counters. Else rays are searched between stages, and the kernel ``sort_lanes`` adds the contributions of shadow
rays, lists lanes and ends paths. A path that ends writes its radiance to the *slot* of its sample;
:mod:`~torchpt.engines.kernels.threads` adds slots to the film.

The methods of :class:`KernelsEngine` are the stages that :func:`torchpt.paths.walk.walk` calls in their order along a path.
A stage is a list of *steps*: kernel calls that name the kernel, the memory that it reads and writes, and where its lanes are
counted. :class:`~torchpt.engines.kernels.calls.Calls` runs a step at once, in the calling thread: a count is an int, and
steps without lanes are left out. On a device (:mod:`~torchpt.engines.kernels.device`) all steps are launched, and counts stay
in memory, where kernels read them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import numpy as np
from torch import Tensor

from torchpt.compiler.form import CAPACITY, VECTORS
from torchpt.engines.kernels.calls import Calls, LaneCount
from torchpt.engines.kernels.eagerly import bounce_eagerly, connect_eagerly
from torchpt.engines.kernels.joins import HostJoins, Joins
from torchpt.engines.kernels.layout import Memory
from torchpt.engines.kernels.programs import Kernel, Kernels
from torchpt.engines.kernels.searches import ChunkSearch
from torchpt.paths.integrators.base import TO_FIRST_SURFACE
from torchpt.paths.layers import LAYERS
from torchpt.paths.photons import PHOTON_ROWS, LightOfSample, PhotonRows, SentLight
from torchpt.paths.state import StageContext
from torchpt.paths.store import BLOCKS, block_of
from torchpt.paths.walk import Counts, Observer, walk
from torchpt.paths.wave import PixelSet, RayCounts
from torchpt.physics.film import Film
from torchpt.physics.film.splats import Splats
from torchpt.physics.samplers import salts

__all__ = [
    "LANES",
    "Chunk",
    "KernelsEngine",
    "Paths",
    "count_samples",
    "film_words",
]

#: Greatest number of lanes of a chunk.
LANES = CAPACITY - VECTORS.width


@dataclass(frozen=True)
class Chunk:
    """Consecutive pixels of a pixel set (None: of the picture), and consecutive samples of each."""

    first_pixel: int
    pixels: int
    first_sample: int
    samples: int
    pixel_set: PixelSet | None = None


# Chunks are added to films by the kernels :func:`torchpt.engines.kernels.stages.accumulate`, a sample at a time.


def film_words(film: Film, chunk: Chunk, samples: int, row: int, clamped: int | None) -> Iterator[tuple[int, ...]]:
    """Yield for each sample of a chunk the words of the kernel's tensors: address and row length of each.

    They are samples and sums in, sums and, with a clamp, samples out.

    Args:
        film: the film.
        chunk: pixels and samples.
        samples: address of the samples ``(channels, samples * pixels)``, those of the first sample of all pixels first.
        row: elements of a row of them.
        clamped: address of the clamped samples, in rows like these; None: no clamp.
    """
    _, channels, pixels = film.sums.shape  # float64, by randomization
    for k in range(chunk.samples):
        group, offset = (chunk.first_sample + k) % film.randomizations, 4 * k * chunk.pixels
        total = film.sums.data_ptr() + 8 * (group * channels * pixels + chunk.first_pixel)
        words = (samples + offset, row, total, pixels, total, pixels)
        yield words if clamped is None else (*words, clamped + offset, row)


def count_samples(film: Film, chunk: Chunk, values: np.ndarray | Tensor) -> None:
    """Count a chunk's samples ``values (channels, samples * pixels)`` in a film, and keep the first one of each pixel."""
    film.count_samples(chunk.first_pixel, chunk.pixels, chunk.first_sample, chunk.samples)
    if chunk.first_sample == 0:
        film.set_first_samples(values[:, : chunk.pixels], chunk.first_pixel)


@dataclass
class Paths:
    """The population of this engine: paths of a chunk at a vertex.

    Attributes:
        arena: the path state, a column a lane.
        lists: lists of lanes: one a BSDF model, then of lanes on emitters, then of lanes without a hit.
        depth: number of the vertex.
        count: number of lanes.
        arrived: True: hits are in the arena.
        listed: True: lanes are in the lists.
        shadows: True: contributions of shadow rays from the vertex before are still pending.
        in_transit: number of rays that may still pass their hits.
        step: number of steps that these took.
        groups: number of lanes on each model.
        places: number of lanes in each list.
    """

    arena: Memory
    lists: list[Memory]
    depth: int = 1
    count: LaneCount = 0
    arrived: bool = False
    listed: bool = False
    shadows: bool = False
    in_transit: LaneCount = 0
    step: int = 0
    groups: Sequence[LaneCount] = ()
    places: Sequence[LaneCount] = ()


class KernelsEngine:
    """The engine of kernels in one thread: traces chunks of paths.

    Args:
        kernels: of the render.
        halt: set to cancel the render; None: it cannot be cancelled.
        calls: runs the kernels; None: in the calling thread.
        store: where light paths keep vertices for connections; None: memory of its own, if the integrator connects paths.

    Attributes:
        traced: what the light paths of the sample have left, while camera paths are merged with photons; else None.
        sent: lanes ``(n,)``, points ``(3, n)`` and data of photons that the chunk's light paths send; None: they are dropped.
        context: of the chunk's stages, for those that run by tensor operations.
        slots: radiance of the chunk's samples.
        store: blocks of vertices of light paths (:mod:`torchpt.paths.store`), a column for each sample; None: there are none.
        shown: layers of the chunk's samples; None before `layers` was called.
        tally: counts of rays and truncated paths of the chunk.
        splats: splats of the chunk's samples, if ``keeps_splats``.
    """

    keeps_splats: ClassVar[bool] = True

    def __init__(
        self, kernels: Kernels, halt: threading.Event | None = None, calls: Any = None, store: Memory | None = None
    ) -> None:
        self.kernels, self.wave = kernels, kernels.wave
        self.calls: Calls = Calls(kernels, halt or threading.Event()) if calls is None else calls
        self.search = self._make_search()
        self.joins = self._make_joins()
        self.slots = self.calls.slots
        self.shown: Memory | None = None
        self.tally = RayCounts()
        self.splats: list[Splats] = []
        self.traced: LightOfSample | None = None
        self.sent: list[tuple[np.ndarray, np.ndarray, np.ndarray]] | None = None
        self.context = kernels.wave.context
        self._lost: list[Any] = []  # samples with splats that are not finite
        self._rooms = [self._room() for _ in range(2)]  # memory of even and of odd vertices
        if store is None and kernels.store is not None and self.wave.integrator.connects:
            store = self.calls.memory(BLOCKS * kernels.store.count)
        self.store = store
        self.light_paths = self._make_light_paths(halt)

    def _make_light_paths(self, halt: threading.Event | None) -> KernelsEngine | None:
        """Return the engine of the light paths that are traced beside the samples; None: there are none."""
        light_paths = self.kernels.light_paths
        return None if light_paths is None else KernelsEngine(light_paths, halt, store=self.store)

    def _make_search(self) -> ChunkSearch:
        return ChunkSearch(self.calls)

    def _make_joins(self) -> Joins:
        return HostJoins(self.search)

    def _room(self) -> Paths:
        """Return new memory for the paths of a vertex."""
        memory = self.calls.memory
        return Paths(memory(self.kernels.state.count), [memory(1) for _ in range(self.kernels.models + 2)])

    def _count_rays(self, lanes: LaneCount, each: int = 1) -> None:
        """Add ``each`` rays for each of ``lanes`` to the tally."""
        self.tally.rays += each * lanes

    def _count_truncated(self, lanes: LaneCount) -> None:
        """Add truncated paths to the tally."""
        self.tally.truncated += lanes

    def room(self, depth: int) -> Paths:
        """Return the memory for a vertex; two buffers alternate."""
        return self._rooms[depth % 2]

    def unbind(self) -> int:
        """Drop all references to the render; return the bytes of memory kept for another one of the same structure."""
        size = sum(memory.words.nbytes for memory in self.memories())
        size += 0 if self.light_paths is None else self.light_paths.unbind()
        self.calls.unbind()
        self.splats, self._lost, self.sent, self.traced = [], [], None, None
        self.search.unbind()
        del self.kernels, self.wave, self.context
        return size

    def memories(self) -> list[Memory]:
        """Return all memory of the engine."""
        memories = [self.slots, *self.search.passed, self.search.transmitting]
        memories += [memory for memory in (self.shown, self.store if self.wave.integrator.connects else None) if memory]
        return memories + [memory for room in self._rooms for memory in (room.arena, *room.lists)]

    def rebind(self, kernels: Kernels, halt: threading.Event) -> None:
        """Reuse the memory for another render of the same structure, after `unbind`."""
        self.kernels, self.wave, self.context = kernels, kernels.wave, kernels.wave.context
        self.calls.rebind(kernels, halt)
        self.search.rebind(kernels)
        if self.light_paths is not None:
            assert kernels.light_paths is not None
            self.light_paths.rebind(kernels.light_paths, halt)

    def trace(self, chunk: Chunk, traced: LightOfSample | None = None) -> RayCounts:
        """Fill ``slots`` with the radiance of a chunk's samples, ``samples`` rows of ``pixels`` one after the other.

        ``traced``: what the light paths of the sample have left, where an integrator merges paths. Paths that were truncated
        there were counted then; they are traced again for the vertices that camera paths are connected to.
        """
        self.tally, self.traced = RayCounts(), traced
        self.set_sample(chunk)
        light_paths = self.light_paths if traced is None or self.wave.integrator.connects else None
        if light_paths is not None:
            self.clear_store(chunk)
            tally = light_paths.trace(chunk)
            self.tally.rays += tally.rays
            self.tally.truncated += tally.truncated if traced is None else 0
        walk(self, self.spawn(chunk), self.wave.integrator.limits)
        self.mark_lost()
        if traced is not None:
            self.splats, lost = traced.of_pixels(chunk.first_pixel, chunk.pixels)
            self.slots.floats[:3, lost] = np.nan
            self.traced = None
        elif light_paths is not None:
            self.take_over(light_paths, chunk)
        return self.tally

    def send(self, chunk: Chunk) -> tuple[RayCounts, SentLight]:
        """Trace the light paths of a chunk of one sample alone; return counts of rays, and what the paths leave."""
        self.set_sample(chunk)
        engine = self.light_paths
        assert engine is not None
        self.clear_store(chunk)
        engine.sent = []
        tally = engine.trace(chunk)
        lost = np.nonzero(~np.isfinite(engine.slots.floats[:3, : chunk.pixels]).all(0))[0]
        sent = SentLight.of(chunk.first_pixel, chunk.pixels, engine.sent, engine.splats, lost)
        engine.sent = None
        return tally, sent

    def set_sample(self, chunk: Chunk) -> None:
        """Set what depends on the chunk's sample, where an integrator merges paths: a chunk has one sample then."""
        if not self.wave.integrator.merging_counts:
            return
        wave = self.wave.at_sample(chunk.first_sample)
        self.context, merging = wave.context, wave.context.merging
        assert merging is not None
        self.calls.set_merging(float(merging))
        if self.light_paths is not None and wave.light_paths is not None:
            self.light_paths.context = wave.light_paths.context
            self.light_paths.calls.set_merging(float(merging))

    def clear_store(self, chunk: Chunk) -> None:
        """Forget the vertices that light paths of the chunk before have kept."""
        rows = self.kernels.store
        if self.store is not None and rows is not None:
            for block in range(BLOCKS):
                self.store.words[block * rows.count + rows.first("count"), : chunk.pixels * chunk.samples] = 0

    def _slots(self, depth: int) -> Any:
        """Return the slots of kernels that read or write the store at vertex ``depth``; None: they do neither."""
        if self.store is None or self.kernels.store is None:
            return None
        connects = self.wave.integrator.connects
        return self.store.below(block_of(depth) * self.kernels.store.count) if connects else self.store

    def take_over(self, light_paths: KernelsEngine, chunk: Chunk) -> None:
        """Take over the splats of the light paths of a chunk, one path for each sample."""
        self.splats, count = light_paths.splats, chunk.pixels * chunk.samples
        # Their radiance is 0, or NaN where a splat is not finite.
        self.slots.floats[:3, :count] += light_paths.slots.floats[:3, :count]

    def mark_lost(self) -> None:
        """Set samples to NaN whose splats are not finite, once all paths ended."""
        for lanes in self._lost:
            self.slots.floats[:3, lanes] = np.nan
        self._lost.clear()

    def layers(self, chunk: Chunk, names: tuple[str, ...]) -> int:
        """Fill ``shown`` with layers of the first surfaces, channel after channel; return the number of rays."""
        count = chunk.pixels * chunk.samples
        channels = sum(len(LAYERS[name].channels) for name in names)
        if self.shown is None or len(self.shown.words) != channels:
            self.shown = self.calls.memory(channels)
        self.shown.words[:, :count] = 0
        walk(self, self.spawn(chunk), TO_FIRST_SURFACE, _Layers(self, names))
        return count

    def start(self, chunk: Chunk) -> None:
        """Set the pixels and samples of the next chunk."""
        wave, pixel_set = self.wave, chunk.pixel_set
        streams = wave.sampler.streams if pixel_set is None else pixel_set.randomizations
        x, y, width, _ = wave.crop
        # samples go to the randomizations in turn
        point, turn = divmod(chunk.first_sample, streams.count)
        point = (point + (1 << 31)) % (1 << 32) - (1 << 31)  # its lower 32 bits, as int32
        film_width, _ = wave.camera.resolution
        numbers = (  # the fields of CHUNK_FIELDS
            chunk.first_pixel, chunk.pixels, turn, point, streams.first, streams.count, x, y, width, film_width,
        )  # fmt: skip
        self.calls.set_chunk(np.array(numbers, np.int64).astype(np.int32))

    def spawn(self, chunk: Chunk) -> Paths:
        """Return the population of a chunk's camera rays, with their first hits if the search is part of the stages."""
        self.start(chunk)
        kernels, calls, start_rays = self.kernels, self.calls, self.wave.start_rays
        self.splats, self._lost = [], []
        count, pixels = chunk.pixels * chunk.samples, None if chunk.pixel_set is None else chunk.pixel_set.indices
        if start_rays is not None:  # the user's rays, in place of camera rays
            pixels = start_rays.number
        paths, source = self._begin(self.room(1), 1, calls.lanes(count)), self.room(1).arena
        calls.clear()
        calls.set_dimensions(depth=0)
        of_chunk = slice(chunk.first_pixel, chunk.first_pixel + chunk.pixels)
        if pixels is not None or start_rays is not None:  # the kernel reads them from the arena of the next vertex
            source = self.room(2).arena
        if pixels is not None:
            source.repeat(kernels.state.first("prim"), pixels[of_chunk][None], chunk.samples)
        if start_rays is not None:
            for name, vectors in (("o", start_rays.o), ("d", start_rays.d)):
                source.repeat(kernels.state.first(name), vectors[:, of_chunk], chunk.samples)
        lists = paths.lists if kernels.fused else None
        kernel = kernels.generate(chosen=pixels is not None, given=start_rays is not None)
        calls.run(kernel, paths.count, source, paths.arena, lists=lists)
        if kernels.fused:
            self._count_rays(paths.count)
        return paths

    def _begin(self, paths: Paths, depth: int, count: LaneCount) -> Paths:
        """Initialize the memory of a vertex for ``count`` paths, and return it."""
        paths.depth, paths.count, paths.shadows, paths.groups = depth, count, False, ()
        paths.in_transit = paths.step = 0
        paths.arrived = paths.listed = self.kernels.fused
        return paths

    # -- the stages of a walk

    def intersect(self, paths: Paths) -> bool:
        """See :class:`torchpt.paths.walk.Engine`."""
        if paths.arrived:
            return False
        self._count_rays(paths.count)
        self.search.nearest(paths.arena, paths.count)
        paths.in_transit = paths.count if self.kernels.has_transmission else 0
        return self.kernels.has_transmission

    def transmit(self, paths: Paths) -> bool:
        """See :class:`torchpt.paths.walk.Engine`."""
        paths.in_transit = self.search.transmit(paths.arena, paths.in_transit, paths.depth, paths.step)
        paths.step += 1
        return bool(paths.in_transit)

    def sort(self, paths: Paths) -> Counts:
        """See :class:`torchpt.paths.walk.Engine`."""
        kernels, calls = self.kernels, self.calls
        if not paths.listed:
            self._sort_lanes(paths)
        live, places = calls.counted()
        paths.groups, paths.places = places[: kernels.models] if kernels.listed else [live], places
        emissive = places[kernels.emissive] if kernels.has_emitters else 0
        return Counts(paths.groups, emissive, places[kernels.missed] if kernels.has_environment else 0)

    def _sort_lanes(self, paths: Paths) -> None:
        """Add pending contributions, list lanes by their hits, and end paths without a hit if there is no environment."""
        calls = self.calls
        calls.clear()
        calls.run(self.kernels.sort_lanes(paths.shadows), paths.count, paths.arena, paths.arena, lists=paths.lists)

    def emit(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        self._on_list(self.kernels.emit(), paths, self.kernels.emissive)

    def escape(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        self._on_list(self.kernels.escape(), paths, self.kernels.missed)

    def _on_list(self, kernel: Kernel, paths: Paths, number: int) -> None:
        """Run a kernel on the lanes of list ``number``."""
        self.calls.set_dimensions(paths.depth)
        self.calls.run(kernel, paths.places[number], paths.arena, paths.arena, paths.lists[number])

    def terminate(self, paths: Paths, truncated: bool) -> None:
        """See :class:`torchpt.paths.walk.Engine`."""
        kernels, calls = self.kernels, self.calls
        if not paths.groups:  # not sorted: all paths end
            if paths.listed:  # compacted: paths that had ended are not in the arena
                paths.count, _ = calls.counted()
            # as rays without a hit that a medium has ended, so that they do not see the environment
            paths.arena.words[kernels.state.first("prim")] = -1
            paths.arena.floats[kernels.state.first("t_max")] = 0.0
            self._sort_lanes(paths)
            return
        for model, count in enumerate(paths.groups):
            if count:
                lanes = paths.lists[model] if kernels.listed else None
                calls.run(kernels.terminate(), count, paths.arena, paths.arena, lanes)
                if truncated:
                    self._count_truncated(count)

    def scatter(self, paths: Paths, roulette: float) -> Paths:
        """See :class:`torchpt.paths.walk.Engine`."""
        kernels, calls = self.kernels, self.calls
        starts, total = calls.running_sums(paths.groups)
        after = self._begin(self.room(paths.depth + 1), paths.depth + 1, total)
        calls.clear()
        calls.set_dimensions(paths.depth, roulette=roulette)
        for model, (count, start) in enumerate(zip(paths.groups, starts, strict=True)):
            if not count:
                continue
            lanes = paths.lists[model]
            if self.traced is not None and not kernels.world.materials.models[model].smooth:
                self._find_photons(paths, lanes.words[0, :count])
            if model in kernels.eager:
                start_salts = self.wave.integrator.start_salts(paths.depth, self.wave.centre.device)
                context = self._context_at(paths.depth, start_salts, roulette)
                arenas, known = (paths.arena, after.arena), (calls.known(count), calls.known(start))
                self.tally.rays += bounce_eagerly(kernels, context, self.store, model, *arenas, lanes, *known)
                continue
            if not kernels.fused:
                calls.write_from(start)
            kernel = kernels.bounce(model, roulette, paths.depth)
            lanes = lanes if kernels.listed else None
            calls.run(kernel, count, paths.arena, after.arena, lanes, lists=after.lists, slots=self._slots(paths.depth))
            self._count_rays(count, kernel.program.shadows + int(kernels.fused))  # with the rays to the next vertex
        return after

    def _context_at(self, depth: int, start_salts: Tensor | None, roulette: float = 0.0) -> StageContext:
        """Return the context of a vertex, for stages by tensor operations."""
        of_vertex = salts(depth, self.wave.centre.device)
        return self.context.at(of_vertex, roulette=roulette, start_salts=start_salts, depth=depth)

    def occlude(self, paths: Paths) -> None:
        """See :class:`torchpt.paths.walk.Engine`. The kernel ``sort_lanes`` adds the contributions later."""
        rows = self.kernels.state
        paths.shadows = self.kernels.has_shadows and "shadow_o" in rows
        if "splat_o" in rows:
            self._splat(paths)
        if self.light_paths is not None and self.wave.integrator.connects:
            self._connect(paths)
        if self.wave.integrator.sends_photons:
            self._send(paths)
        if paths.shadows:
            self.search.light(paths.arena, paths.count)

    def _find_photons(self, paths: Paths, lanes: np.ndarray) -> None:
        """Write the photons that vertices of the camera paths ``lanes`` are merged with to their rows."""
        assert self.traced is not None
        rows, arena = self.kernels.state, paths.arena
        o, d, t, found, key = (rows.first(name) for name in ("o", "d", "t", "photon_d", "key"))
        photon_rows = PhotonRows(o, d, t, key, self.wave.sampler.points.rows, found)
        self.traced.photons.write_near(arena.words, photon_rows, lanes, paths.depth)

    def _send(self, paths: Paths) -> None:
        """Keep the photons that light paths have sent from the vertex that ``paths`` have left."""
        rows, arena = self.kernels.state, paths.arena
        if self.sent is None:
            return
        floats, words = cast(Any, arena.floats), cast(Any, arena.words)
        lanes = np.nonzero(floats[rows.first("photon_depth"), : paths.count])[0]
        p, data = rows.first("photon_p"), rows.first("photon_d")
        found = floats[p : p + 3, lanes], floats[data : data + PHOTON_ROWS, lanes]
        self.sent.append((words[rows.first("lane"), lanes], *found))

    def _splat(self, paths: Paths) -> None:
        """Record splats that reach the film. One that is not finite is left out and makes its sample NaN."""
        found = self.joins.splats(paths.arena, paths.count)
        if found is not None:
            splats, lost = found
            self._lost.append(lost)
            if self.keeps_splats:
                self.splats.append(splats)

    def _connect(self, paths: Paths) -> None:
        """Connect the vertices that ``paths`` have left to those that their light paths keep, and add the light."""
        kernels, calls, depth = self.kernels, self.calls, paths.depth - 1
        calls.clear()
        calls.run(kernels.list_ends(), paths.count, paths.arena, paths.arena, lists=paths.lists)
        _, places = calls.counted()
        for model, kind in enumerate(kernels.world.materials.models):
            count, lanes = places[model], paths.lists[model]
            if not count or kind.smooth:
                continue
            self._count_rays(count)
            if model in kernels.eager:
                assert self.store is not None
                context, known = self._context_at(depth, salts(0, self.wave.centre.device)), calls.known(count)
                connect_eagerly(kernels, context, self.store, model, paths.arena, lanes, known)
            else:
                slots = self._slots(depth)
                calls.run(kernels.connect(model), count, paths.arena, paths.arena, lanes, slots=slots)
        self.joins.connect(paths.arena, paths.count)


class _Layers(Observer[Paths]):
    """Evaluates layers of first surfaces, and ends the walk there."""

    def __init__(self, worker: KernelsEngine, names: tuple[str, ...]) -> None:
        self.worker, self.names = worker, names

    def on_sorted(self, paths: Paths, counts: Counts) -> bool:
        """See :class:`Observer`."""
        worker, kernels = self.worker, self.worker.kernels
        for model, count in enumerate(paths.groups):
            if count:
                lanes = paths.lists[model] if kernels.listed else None
                kernel = kernels.layers(model, self.names)
                worker.calls.run(kernel, count, paths.arena, paths.arena, lanes, slots=worker.shown)
        return True
