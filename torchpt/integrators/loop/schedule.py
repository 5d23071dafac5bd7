"""Which thread takes which samples, and how they add up to a picture."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field

import numpy as np
import torch

from torchpt.film import Film
from torchpt.integrators import LAYERS
from torchpt.integrators.loop.calls import Halted
from torchpt.integrators.loop.chunk import LANES, Chunk, Worker
from torchpt.integrators.loop.kernels import Kernels
from torchpt.integrators.lost import Lost
from torchpt.integrators.path import Tally
from torchpt.integrators.plate import Plate
from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.block import WIDTH
from torchpt.lanes.kernel import HEAD

__all__ = ["Loop", "Share"]

#: Tasks of a pass for each thread, so that none waits long for the last one.
TASKS = 6
#: Fewest lanes that repay a task.
FEWEST = 1024
#: Pixels of a task, unless threads would be idle: a chunk of many samples of few pixels adds them up in as many steps.
NARROW = 128
#: Seconds after which the thread that asked for the render looks whether it is to end.
PATIENCE = 0.05


@dataclass
class Share:
    """What a task brought beside its samples.

    Attributes:
        tally: rays and paths.
        samples: camera samples taken.
        lost: samples that were not finite.
        light: before and after the clamp.
    """

    tally: Tally
    samples: int = 0
    lost: Lost = field(default_factory=Lost)
    light: tuple[float, float] = (0.0, 0.0)


class Loop:
    """A render's tasks over threads. A pixel's samples are summed in their order, whichever thread takes them.

    Args:
        kernels: of the render.
        threads: how many.
        lanes: most of a chunk; None: as many as caches like.
        clamp: largest contribution of a path, or None.
        strict: whether a task ends at a sample that is not finite; whoever is told of it ends the render.
    """

    def __init__(
        self,
        kernels: Kernels,
        threads: int,
        lanes: int | None,
        clamp: float | None,
        strict: bool,
    ) -> None:
        self.kernels, self.threads, self.clamp, self.strict = kernels, threads, clamp, strict
        self.lanes = LANES if lanes is None else max(1, min(lanes, LANES))
        self._workers: list[Worker] = []
        self._lock = threading.Lock()
        self._halt = threading.Event()

    def run(self, spans: Sequence[tuple[Plate, int, int]], each: Callable[[Share | None], bool]) -> bool:
        """Takes samples of every pixel of plates.

        Args:
            spans: plates, with the first sample and how many are to be taken.
            each: called in this thread after every task, and now and then with None while tasks run (or compile);
                returning True ends the render: tasks stop at their next kernel.

        Returns:
            Whether all were taken.
        """
        blocks = [
            (plate, start, size, first, count)
            for plate, first, count in spans
            for start, size in self._blocks(plate, count)
        ]
        # Tasks never run in this thread: it looks after signals.
        pool = ThreadPoolExecutor(min(self.threads, len(blocks)), thread_name_prefix="torchpt")
        try:
            waiting: set[Future[Share]] = {pool.submit(self._task, *block) for block in blocks}
            while waiting:
                done, waiting = wait(waiting, PATIENCE, FIRST_COMPLETED)
                shares = [future.result() for future in done if not future.cancelled()]
                if any([each(share) for share in shares or [None]]):
                    self._halt.set()
                    for future in waiting:
                        future.cancel()
            return not self._halt.is_set()
        except BaseException:
            self._halt.set()
            raise
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _blocks(self, plate: Plate, samples: int) -> Iterator[tuple[int, int]]:
        """Consecutive pixels of each task."""
        pixels = plate.film.width * plate.film.height
        size = -(-pixels // (self.threads * TASKS)) if self.threads > 1 else pixels
        size = max(size, -(-FEWEST // samples), min(NARROW, -(-pixels // self.threads)))
        size = min(-(-size // WIDTH) * WIDTH, self.lanes)
        for start in range(0, pixels, size):
            yield start, min(size, pixels - start)

    def _task(self, plate: Plate, start: int, size: int, first: int, count: int) -> Share:
        with self._lock:
            worker = self._workers.pop() if self._workers else Worker(self.kernels, self._halt)
        share = Share(Tally())
        try:
            step = max(self.lanes // size, 1)
            for sample in range(first, first + count, step):
                chunk = Chunk(start, size, sample, min(step, first + count - sample), plate)
                if self.kernels.wave.limits is not None:
                    self._radiance(worker, chunk, plate, share)
                if plate.layers:
                    self._layers(worker, chunk, plate, share)
                share.samples += size * chunk.samples
                if self.strict and share.lost.count:
                    break
        except Halted:
            pass  # what was added so far counts
        finally:
            with self._lock:
                self._workers.append(worker)
        return share

    def _radiance(self, worker: Worker, chunk: Chunk, plate: Plate, share: Share) -> None:
        tally = worker.trace(chunk)
        share.tally.rays += tally.rays
        share.tally.truncated += tally.truncated
        values = worker.slots.floats
        used = values[:, : chunk.pixels * chunk.samples]
        if self.clamp is None:
            if self._deposit(worker, values, chunk, plate.film, 3, None):
                share.lost.add(self._lost(used, chunk))
            return
        finite = np.isfinite(used).all(0)
        if not finite.all():
            share.lost.add(self._lost(used, chunk))  # the clamp writes over them
        before = float(np.where(finite, used, 0.0).sum(dtype=np.float64))
        self._deposit(worker, values, chunk, plate.film, 3, self.clamp)
        share.light = share.light[0] + before, share.light[1] + float(np.ascontiguousarray(used).sum(dtype=np.float64))

    def _layers(self, worker: Worker, chunk: Chunk, plate: Plate, share: Share) -> None:
        names = tuple(plate.layers)
        share.tally.rays += worker.layers(chunk, names)
        assert worker.shown is not None
        first = 0
        for name in names:
            channels = len(LAYERS[name].channels)
            values = worker.shown.floats[first : first + channels]
            self._deposit(worker, values, chunk, plate.layers[name], channels, None)
            first += channels

    def _deposit(
        self, worker: Worker, values: np.ndarray, chunk: Chunk, film: Film, channels: int, clamp: float | None
    ) -> int:
        """Adds samples to a film in their order; returns how many were not finite."""
        made = self.kernels.deposit(channels, clamp is not None)
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
        film.counted(chunk.first_pixel, n, chunk.first_sample, chunk.samples)
        if chunk.first_sample == 0:
            film.keep_first(values[:, :n], chunk.first_pixel)
        return int(counters[0])

    def _lost(self, used: np.ndarray, chunk: Chunk) -> Lost:
        """Which samples of a chunk are not finite, of the radiance ``(3, samples * pixels)`` of all."""
        radiance = torch.from_numpy(used).view(3, chunk.samples, chunk.pixels)
        return Lost.of(radiance, chunk.first_pixel, chunk.first_sample, self.kernels.wave.crop, chunk.plate)
