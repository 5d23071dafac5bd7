"""The forward engine of kernels: tasks on threads, adding samples to films, and memory that renders reuse."""

from __future__ import annotations

import ctypes
import os
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from torchpt.compiler.form import CAPACITY, VECTORS
from torchpt.compiler.kernel import HEAD
from torchpt.core.memory import Budget, explain_out_of_memory, is_out_of_memory, on_low_memory
from torchpt.core.threads import map_in_order
from torchpt.engines.kernels.engine import LANES, Chunk, Halted, KernelsEngine
from torchpt.engines.kernels.programs import Kernels
from torchpt.engines.work import TASKS, Block, TaskResult
from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts, clamp_scale
from torchpt.physics.film import Film

__all__ = ["KernelsForward", "keep_worker", "reuse_worker"]


# ---- Idle engines, kept for the next render of the same structure, since new memory costs time


#: Most bytes of idle engines; the oldest are dropped first.
MAX_KEPT_BYTES = 64 << 20

_lock = threading.Lock()
_kept: deque[tuple[Hashable, KernelsEngine, int]] = deque()


def keep_worker(structure: Hashable, worker: KernelsEngine) -> None:
    """Keep the engine of a thread for renders of a structure; it drops its references to the old render."""
    size = worker.unbind()
    with _lock:
        _kept.append((structure, worker, size))
        total = sum(one[2] for one in _kept)
        while total > MAX_KEPT_BYTES:
            total -= _kept.popleft()[2]


def reuse_worker(structure: Hashable) -> KernelsEngine | None:
    """Remove and return the latest kept engine for a structure; None if there is none."""
    with _lock:
        for number in reversed(range(len(_kept))):
            if _kept[number][0] == structure:
                worker = _kept[number][1]
                del _kept[number]
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


#: Fewest lanes of a task, unless the picture has fewer.
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
        return self.take(self.blocks(spans, self.budget.threads * TASKS), each)

    def blocks(self, spans: Sequence[tuple[PixelSet, int, int]], tasks: int) -> list[Block]:
        """Split the samples of pixel sets into blocks of pixels: ``tasks`` for each set, unless blocks get too small."""
        return [
            (pixel_set, start, size, first, count)
            for pixel_set, first, count in spans
            for start, size in self._cut(pixel_set, count, tasks)
        ]

    def take(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render blocks; ``each`` and the returned value as for :meth:`run`."""
        while blocks and not self._halt.is_set():
            blocks = self._round(blocks, each)
            if blocks:
                blocks = self._smaller(blocks)
        return not self._halt.is_set()

    def retry_blocks(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> bool:
        """Render blocks that ran out of memory again, with fewer threads or lanes; else as :meth:`take`."""
        return self.take(self._smaller(blocks), each)

    def _round(self, blocks: list[Block], each: Callable[[TaskResult | None], bool]) -> list[Block]:
        """Render blocks on threads; return the blocks that ran out of memory."""
        rest: list[Block] = []

        def told(share: TaskResult | None) -> bool:
            if share is not None:
                rest.extend(share.rest)
            return each(share)

        map_in_order(blocks, self.task, self.budget.threads, told, self._halt)
        return rest

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
        """Yield the consecutive pixels of each task."""
        pixels = pixel_set.film.width * pixel_set.film.height
        size = pixels
        threads = self.budget.threads
        if tasks > 1 and threads > 1:
            size = max(-(-pixels // tasks), -(-MIN_TASK_LANES // samples), min(MIN_TASK_PIXELS, -(-pixels // threads)))
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
        pixel_set, start, size, first, count = block
        share = TaskResult(RayCounts())
        sample = first
        try:
            worker = self._worker()
            step = max(self.budget.lanes // size, 1)
            while sample < first + count:
                chunk = Chunk(start, size, sample, min(step, first + count - sample), pixel_set)
                self._chunk(worker, chunk, pixel_set, share)
                sample += chunk.samples
                share.samples += size * chunk.samples
                if self.strict and share.lost.count:
                    break
            self._workers.append(worker)
        except Halted:
            pass  # samples added so far count
        except Exception as error:
            if not is_out_of_memory(error):
                raise
            share.rest = [(pixel_set, start, size, sample, first + count - sample)]
        return share

    def _worker(self) -> KernelsEngine:
        try:
            return self._workers.pop()
        except IndexError:
            worker = reuse_worker(self.kernels.structure)
        if worker is None:
            return KernelsEngine(self.kernels, self._halt)
        worker.rebind(self.kernels, self._halt)
        return worker

    def _chunk(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet, share: TaskResult) -> None:
        """Render a chunk and add it to the films: all of it, or nothing if memory runs out."""
        names, light = tuple(pixel_set.layers), self.kernels.wave.integrator.light
        rays = worker.layers(chunk, names) if names else 0
        for film in pixel_set.layers.values():
            self.kernels.accumulate(film.channels, False)
        if light:
            self.kernels.accumulate(3, self.clamp is not None)
            tally = worker.trace(chunk)
            share.tally.truncated += tally.truncated
            rays += tally.rays
        # From here on a failure would leave half a chunk in the films, so running out of memory ends the render.
        with explain_out_of_memory("the sums of a film"):
            if light:
                self._radiance(worker, chunk, pixel_set, share)
                self._splats(worker, chunk, pixel_set.film, share)
            if names:
                self._layers(worker, chunk, pixel_set)
        share.tally.rays += rays

    def _radiance(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet, share: TaskResult) -> None:
        values = worker.slots.floats
        used = values[:, : chunk.pixels * chunk.samples]
        if self.clamp is None:
            if self._accumulate(worker, values, chunk, pixel_set.film, 3, None):
                share.lost.add(self._lost(used, chunk))
            return
        finite = np.isfinite(used).all(0)
        if not finite.all():
            share.lost.add(self._lost(used, chunk))  # the clamp writes over them
        before = float(np.where(finite, used, 0.0).sum(dtype=np.float64))
        self._accumulate(worker, values, chunk, pixel_set.film, 3, self.clamp)
        share.light = share.light[0] + before, share.light[1] + float(np.ascontiguousarray(used).sum(dtype=np.float64))

    def _splats(self, worker: KernelsEngine, chunk: Chunk, film: Film, share: TaskResult) -> None:
        """Add the splats of a chunk's samples to the film."""
        before = after = 0.0
        for splats in worker.splats:
            assert film.splats is not None
            value = splats.value
            if self.clamp is not None:
                before += float(value.sum(dtype=torch.float64))
                value = value * clamp_scale(value, self.clamp)
                after += float(value.sum(dtype=torch.float64))
            stream = film.randomization_of(chunk.first_sample + splats.lane // chunk.pixels)
            film.splats.add(stream, splats.pixel, value)
        share.light = share.light[0] + before, share.light[1] + after

    def _layers(self, worker: KernelsEngine, chunk: Chunk, pixel_set: PixelSet) -> None:
        assert worker.shown is not None
        first = 0
        for film in pixel_set.layers.values():
            values = worker.shown.floats[first : first + film.channels]
            self._accumulate(worker, values, chunk, film, film.channels, None)
            first += film.channels

    def _accumulate(
        self, worker: KernelsEngine, values: np.ndarray, chunk: Chunk, film: Film, channels: int, clamp: float | None
    ) -> int:
        """Add samples to a film in their order; return how many were not finite."""
        made = self.kernels.accumulate(channels, clamp is not None)
        kernel = made.program
        counters = np.zeros(1, np.int64)
        limit = np.array([clamp or 0.0], np.float32)
        words = (ctypes.c_int64 * (len(HEAD) + len(kernel.uniforms) + 2 * (kernel.tensors + kernel.results)))()
        words[HEAD.index("counters")] = counters.ctypes.data
        words[HEAD.index("tables")] = made.tables.address
        if kernel.uniforms:
            words[len(HEAD)] = limit.ctypes.data
        rest = len(HEAD) + len(kernel.uniforms)  # input and output tensors: addresses and lengths of rows
        sums, n = film.sums, chunk.pixels
        pixels = sums.shape[2]
        for k in range(chunk.samples):
            group = (chunk.first_sample + k) % film.randomizations
            source = values.ctypes.data + 4 * k * n
            total = sums.data_ptr() + 8 * (group * channels * pixels + chunk.first_pixel)
            words[rest : rest + 6] = (source, CAPACITY, total, pixels, total, pixels)
            if clamp is not None:
                words[rest + 6], words[rest + 7] = source, CAPACITY
            kernel.call(ctypes.addressof(words), n)
        film.count_samples(chunk.first_pixel, n, chunk.first_sample, chunk.samples)
        if chunk.first_sample == 0:
            film.set_first_samples(values[:, :n], chunk.first_pixel)
        return int(counters[0])

    def _lost(self, used: np.ndarray, chunk: Chunk) -> NonFinite:
        """Return the counts of non-finite samples of a chunk with radiance ``used (3, samples * pixels)``."""
        radiance = torch.from_numpy(used).view(3, chunk.samples, chunk.pixels)
        return NonFinite.of(radiance, chunk.first_pixel, chunk.first_sample, self.kernels.wave.crop, chunk.pixel_set)
