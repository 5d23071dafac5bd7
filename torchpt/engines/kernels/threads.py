"""The forward engine of kernels: tasks on threads, adding samples to films, and memory that renders reuse.

A *block* (some pixels, all their samples of a pass) is one task. A thread renders it in *chunks*, as many samples at a time as
its memory has lanes for, with an engine of its own (a *worker*), and adds each chunk to the films.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from torchpt.compiler.cache import note_unasked
from torchpt.compiler.form import CAPACITY, VECTORS
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.core.memory import Budget, explain_out_of_memory, is_out_of_memory, on_low_memory
from torchpt.core.threads import map_in_order
from torchpt.engines.kernels.calls import Arguments, Halted
from torchpt.engines.kernels.engine import LANES, Chunk, KernelsEngine, count_samples, film_words
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.work import TASKS, Block, TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.photons import LightOfSample, SentLight
from torchpt.paths.wave import PixelSet, RayCounts, clamp_scale
from torchpt.physics.film import Film
from torchpt.physics.film.splats import Splats

__all__ = ["KernelsForward", "keep_worker", "reuse_worker"]


# ---- Idle engines, kept for the next render of the same structure, since new memory costs time


#: Most bytes of idle engines; the oldest are dropped first.
MAX_KEPT_BYTES = 64 << 20

_lock = threading.Lock()
_kept: deque[tuple[Hashable, KernelsEngine, int]] = (
    deque()
)  # structure of the render, engine, its bytes; the oldest first


def keep_worker(structure: Hashable, worker: KernelsEngine) -> None:
    """Keep the engine of a thread for renders of a structure; it drops its references to the old render."""
    size = worker.unbind()
    with _lock:
        _kept.append((structure, worker, size))
        total = sum(kept_size for _, _, kept_size in _kept)
        while total > MAX_KEPT_BYTES:
            _, _, dropped_size = _kept.popleft()
            total -= dropped_size


def reuse_worker(structure: Hashable) -> KernelsEngine | None:
    """Remove and return the latest kept engine for a structure; None if there is none."""
    with _lock:
        for index in reversed(range(len(_kept))):
            kept_structure, worker, _ = _kept[index]
            if kept_structure == structure:
                del _kept[index]
                return worker
    return None


def _release() -> None:
    with _lock:
        _kept.clear()


def _after_fork() -> None:
    """Replace the lock: a thread of the parent process may have held the old one."""
    global _lock
    _lock = threading.Lock()


on_low_memory(_release)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


# ---- The forward engine


#: Fewest lanes of a task, unless the picture has fewer, so that the calls of kernels cost little beside their lanes.
MIN_TASK_LANES = 1024
#: Fewest pixels of a task, unless threads would be idle: samples of a pixel are added one step each, so few pixels cost time.
MIN_TASK_PIXELS = 128


class KernelsForward:
    """Forward engine of kernels: the tasks of a render on threads; see :class:`torchpt.engines.engine.Tasks`.

    The samples of a pixel are added in their order, independent of threads.

    Args:
        kernels: of the render.
        threads: number of threads.
        clamp: largest component of a sample; None: unbounded.
        strict: True: a task ends at its first chunk with a sample that is not finite; the caller has to end the render.

    Attributes:
        compiled: True, see :class:`torchpt.engines.engine.Forward`.
        budget: number of threads, and greatest number of lanes of a chunk.
    """

    compiled = True

    def __init__(self, kernels: Kernels, threads: int, clamp: float | None, strict: bool) -> None:
        self.kernels, self.clamp, self.strict = kernels, clamp, strict
        self.budget = Budget(
            torch.device("cpu"),
            LANES,
            threads,
            what="the compiled loop on one thread",
            fallback="one thread and fewer lanes",
            min_lanes=VECTORS.width,
        )
        self._workers: list[KernelsEngine] = []
        self._traced: LightOfSample | None = None  # what the light paths of the sample have left
        self._halt = threading.Event()

    @property
    def seconds(self) -> float:
        """Return the seconds spent on making kernels."""
        return self.kernels.seconds

    def rows(self, layers: Mapping[str, Any]) -> int:
        """Return how many 32-bit numbers a lane takes in each thread, for these layers."""
        return self.kernels.rows(layers)

    def run(self, spans: Sequence[tuple[PixelSet, int, int]], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render samples of every pixel of pixel sets.

        Args:
            spans: pixel sets, each with its first sample and number of samples.
            each: called in this thread after every task, and now and then with None while tasks run (or compile);
                returning True ends the render: tasks stop at their next kernel.

        Returns:
            True if all samples were rendered.
        """
        self.kernels.prefetch(self.budget.threads)
        complete = self._run(spans, each)
        if complete:
            note_unasked()
        return complete

    def _run(self, spans: Sequence[tuple[PixelSet, int, int]], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render samples ``first, count`` of sets of pixels; with merging, sample by sample. Return False if halted."""
        integrator = self.kernels.wave.integrator
        if not integrator.merging_counts:
            return self.take(self.blocks(spans, self.budget.threads * TASKS), each)
        for pixel_set, first, count in spans:
            for sample in range(first, first + count):
                self._traced = None  # before memory is taken for the next one
                if integrator.merges:
                    self._traced = self._trace_light(pixel_set, sample, each)
                blocks = self.blocks([(pixel_set, sample, 1)], self.budget.threads)
                if self._halt.is_set() or not self.take(blocks, each):
                    return False
        self._traced = None
        return True

    def _trace_light(
        self, pixel_set: PixelSet, sample: int, each: Callable[[TaskResult | None], bool]
    ) -> LightOfSample | None:
        """Trace the light paths of one sample of all pixels, and return what they leave; None if the render was ended."""
        wave = self.kernels.wave
        sent: list[SentLight] = []

        def on_result(result: TaskResult | None) -> bool:
            if result is not None and result.sent is not None:
                sent.append(result.sent)
            return each(result)

        blocks = self.blocks([(pixel_set, sample, 1)], self.budget.threads)
        if wave.light_paths is not None and not self.take(blocks, on_result, self._light_task):
            return None
        radius = wave.integrator.radius_at(sample)
        assert radius is not None
        while True:
            try:
                return LightOfSample.of(sent, radius, wave.light_path_count)
            except Exception as error:
                if not is_out_of_memory(error):
                    raise
                self._smaller([])

    def _light_task(self, block: Block) -> TaskResult:
        """Trace the light paths of a block of one sample; called on any thread."""

        def send(worker: KernelsEngine, result: TaskResult) -> None:
            pixel_set, start, size, first, _ = block
            tally, result.sent = worker.send(Chunk(start, size, first, 1, pixel_set))
            result.tally.rays, result.tally.truncated = tally.rays, tally.truncated

        return self._attempt(block, send)

    def blocks(self, spans: Sequence[tuple[PixelSet, int, int]], tasks: int) -> list[Block]:
        """Split the samples of pixel sets into blocks of pixels: ``tasks`` for each set, unless blocks get too small."""
        return [
            (pixel_set, start, size, first, count)
            for pixel_set, first, count in spans
            for start, size in self._cut(pixel_set, count, tasks)
        ]

    def take(
        self,
        blocks: list[Block],
        each: Callable[[TaskResult | None], bool],
        task: Callable[[Block], TaskResult] | None = None,
    ) -> bool:
        """Run ``task`` (None: :meth:`task`) for blocks; ``each`` and the returned value as for :meth:`run`."""
        while blocks and not self._halt.is_set():
            blocks = self._round(blocks, each, task or self.task)
            if blocks:
                blocks = self._smaller(blocks)
        return not self._halt.is_set()

    def retry_blocks(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render blocks that ran out of memory again, with fewer threads or lanes; else as :meth:`take`."""
        return self.take(self._smaller(blocks), each)

    def _round(
        self, blocks: list[Block], each: Callable[[TaskResult | None], bool], task: Callable[[Block], TaskResult]
    ) -> list[Block]:
        """Run a task for blocks on threads; return the blocks that ran out of memory."""
        unfinished: list[Block] = []

        def on_result(result: TaskResult | None) -> bool:
            if result is not None:
                unfinished.extend(result.unfinished)
            return each(result)

        is_small = len(blocks) == 1 and all(size * count <= LANES for _, _, size, _, count in blocks)  # a single chunk
        map_in_order(blocks, task, self.budget.threads, on_result, self._halt, here=is_small)
        return unfinished

    def _smaller(self, blocks: list[Block]) -> list[Block]:
        """Shrink the budget, and return the blocks split so that each fits into a chunk.

        Raises:
            RenderError: not enough memory for one thread and one vector of lanes.
        """
        self._workers.clear()
        self.budget.shrink()
        lanes = self.budget.lanes
        return [
            (pixel_set, pixel, min(lanes, start + size - pixel), first, count)
            for pixel_set, start, size, first, count in blocks
            for pixel in range(start, start + size, lanes)
        ]

    def _cut(self, pixel_set: PixelSet, samples: int, tasks: int) -> Iterator[tuple[int, int]]:
        """Yield first pixel and number of pixels of each task."""
        pixels = pixel_set.film.width * pixel_set.film.height
        size = pixels
        threads = self.budget.threads
        if tasks > 1 and threads > 1:
            size = max(-(-pixels // tasks), -(-MIN_TASK_LANES // samples), min(MIN_TASK_PIXELS, -(-pixels // threads)))
        # whole vectors, but not more than fit in memory
        size = max(min(-(-size // VECTORS.width) * VECTORS.width, self.budget.lanes), 1)
        for start in range(0, pixels, size):
            yield start, min(size, pixels - start)

    def release_workers(self, keeps: bool) -> None:
        """Release the engines of threads, or (``keeps``) keep them for the next render of the same structure."""
        while self._workers:
            worker = self._workers.pop()
            if keeps:
                keep_worker(self.kernels.structure, worker)

    def halt(self) -> None:
        """Cancel the render: tasks stop at their next kernel."""
        self._halt.set()

    def task(self, block: Block) -> TaskResult:
        """Render a block; called on any thread."""

        def render(worker: KernelsEngine, result: TaskResult) -> None:
            pixel_set, start, size, first, count = block
            samples_per_chunk = max(self.budget.lanes // size, 1)
            for sample in range(first, first + count, samples_per_chunk):
                chunk = Chunk(start, size, sample, min(samples_per_chunk, first + count - sample), pixel_set)
                self._render_chunk(worker, chunk, pixel_set, result)
                result.samples += size * chunk.samples
                if self.strict and result.lost.count:
                    break

        return self._attempt(block, render)

    def _attempt(self, block: Block, work: Callable[[KernelsEngine, TaskResult], None]) -> TaskResult:
        """Do the work of a block with an engine; what is left of it when memory runs out is unfinished."""
        pixel_set, start, size, first, count = block
        result = TaskResult(RayCounts())
        try:
            worker = self._take_worker()
            work(worker, result)
            self._workers.append(worker)
        except Halted:
            pass  # samples added so far count
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            done = result.samples // size
            result.unfinished = [(pixel_set, start, size, first + done, count - done)]
        return result

    def _take_worker(self) -> KernelsEngine:
        """Return an idle engine of this render, or of an earlier one of the same structure, or a new one."""
        try:
            return self._workers.pop()
        except IndexError:
            worker = reuse_worker(self.kernels.structure)
        if worker is None:
            return KernelsEngine(self.kernels, self._halt)
        worker.rebind(self.kernels, self._halt)
        return worker

    def _render_chunk(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet, result: TaskResult) -> None:
        """Render a chunk and add it to the films: all of it, or nothing if memory runs out."""
        names, light = tuple(pixel_set.layers), self.kernels.wave.integrator.light
        rays = worker.layers(chunk, names) if names else 0
        # kernels that add to films are compiled before anything is added
        for film in pixel_set.layers.values():
            self.kernels.accumulate(film.channels, clamp=False)
        if light:
            self.kernels.accumulate(channels=3, clamp=self.clamp is not None)
            tally = worker.trace(chunk, self._traced)
            result.tally.truncated += tally.truncated
            rays += tally.rays
        # From here on a failure would leave half a chunk in the films, so running out of memory ends the render.
        with explain_out_of_memory("the sums of a film"):
            if light:
                self._add_radiance(worker, chunk, pixel_set, result)
                self._add_splats(worker.splats, chunk, pixel_set.film, result)
            if names:
                self._add_layers(worker, chunk, pixel_set)
        result.tally.rays += rays

    def _add_radiance(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet, result: TaskResult) -> None:
        """Add the radiance of a chunk's samples to the film."""
        values = worker.slots.floats
        samples = values[:, : chunk.pixels * chunk.samples]
        if self.clamp is None:
            if self._accumulate(values, chunk, pixel_set.film, clamp=None):
                result.lost.add(self._lost(samples, chunk))
            return
        finite = np.isfinite(samples).all(0)
        if not finite.all():
            result.lost.add(self._lost(samples, chunk))  # before the clamp writes over them
        before = float(np.where(finite, samples, 0.0).sum(dtype=np.float64))
        self._accumulate(values, chunk, pixel_set.film, clamp=self.clamp)
        after = float(np.ascontiguousarray(samples).sum(dtype=np.float64))
        self._count_light(result, before, after)

    def _count_light(self, result: TaskResult, before: float, after: float) -> None:
        """Add to the sums of radiance before and after the firefly clamp."""
        sum_before, sum_after = result.light
        result.light = sum_before + before, sum_after + after

    def _add_splats(self, found: Sequence[Splats], chunk: Chunk, film: Film, result: TaskResult) -> None:
        """Add the splats of a chunk's samples to the film."""
        before = after = 0.0
        for splats in found:
            assert film.splats is not None
            value = splats.value
            if self.clamp is not None:
                before += float(value.sum(dtype=torch.float64))
                value = value * clamp_scale(value, self.clamp)
                after += float(value.sum(dtype=torch.float64))
            # lanes run over the pixels of a sample, then over samples
            stream = film.randomization_of(chunk.first_sample + splats.lane // chunk.pixels)
            film.splats.add(stream, splats.pixel, value)
        self._count_light(result, before, after)

    def _add_layers(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet) -> None:
        """Add the layers of a chunk's samples to their films."""
        assert worker.shown is not None
        first = 0
        for film in pixel_set.layers.values():
            values = worker.shown.floats[first : first + film.channels]
            self._accumulate(values, chunk, film, clamp=None)
            first += film.channels

    def _accumulate(self, values: np.ndarray, chunk: Chunk, film: Film, clamp: float | None) -> int:
        """Add samples to a film in their order; return how many were not finite.

        Args:
            values: ``(channels, CAPACITY)`` float32: the chunk's samples, those of the first sample of all pixels first.
            chunk: pixels and samples.
            film: the film.
            clamp: largest component of a sample, and clamped samples are written back to ``values``; None: no clamp.
        """
        arguments = Arguments(self.kernels.accumulate(film.channels, clamp=clamp is not None), CAPACITY)
        call, words, first = arguments.kernel.program.call, arguments.words, arguments.tensors
        counters = np.zeros(1, np.int64)  # of samples that are not finite
        limit = np.array([clamp or 0.0], np.float32)
        words[WORD["counters"]] = counters.ctypes.data
        if clamp is not None:
            words[len(HEAD)] = limit.ctypes.data
        samples = values.ctypes.data
        for tensors in film_words(film, chunk, samples, CAPACITY, None if clamp is None else samples):
            words[first:] = tensors
            call(ctypes.addressof(words), chunk.pixels)
        count_samples(film, chunk, values)
        return int(counters[0])

    def _lost(self, samples: np.ndarray, chunk: Chunk) -> NonFinite:
        """Return the counts of non-finite samples of a chunk with radiance ``samples (3, samples * pixels)``."""
        radiance = torch.from_numpy(samples).view(3, chunk.samples, chunk.pixels)
        return NonFinite.of(radiance, chunk.first_pixel, chunk.first_sample, self.kernels.wave.crop, chunk.pixel_set)
