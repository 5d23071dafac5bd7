"""Memory: used and free memory, the limit of a job, and what is done when memory runs out.

A *job* is a render or a gradient. It has threads, each of which traces some lanes at once: elements of tensors, one for each
sample of a pixel. Lanes that are traced together are a *wave*; a *chunk* is the pixels and samples of a wave. Under a limit
(``render.max_memory``) a :class:`Budget` chooses the numbers of threads and lanes: by the known size of a lane (``fit``), or by
the measured size of earlier ones (``run_in_chunks``). If an allocation fails all the same, caches are freed
(:func:`release_memory`), then one thread goes on alone, then with half as many lanes, and so on (``shrink``). If the fewest
lanes do not fit, a one-line error is raised.

The limit is on the memory of the process above that after import. Memory in use (scene, search structure, world) is measured;
memory to come (films, the final picture, code to load) is estimated by each job.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import mmap
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import torch

from torchpt.core.errors import RenderError, SceneError, TorchptError, warn_once

__all__ = [
    "FIRST_WAVE_LANES",
    "Budget",
    "MemoryMeter",
    "Span",
    "after_import",
    "check_address_space",
    "check_limit",
    "check_memory",
    "explain_out_of_memory",
    "fits_in_memory",
    "free_memory",
    "is_out_of_memory",
    "mb",
    "on_low_memory",
    "release_memory",
    "retry_out_of_memory",
    "trim_heap",
]

#: Lanes of the first wave under a limit. After it all code is loaded, whose memory must not count as that of lanes.
FIRST_WAVE_LANES = 4096
#: Fraction of the free memory that waves may fill: the next one may need more than the measured one.
WAVE_FRACTION = 0.88
#: Largest growth of a wave, as a factor, over the one before.
MAX_GROWTH = 2
#: Factor on the expected bytes of a lane for the second wave, the first one that is measured.
UNMEASURED_FACTOR = 4
#: Bytes of address space that libraries may need to make code; some of them abort the process without it.
CODE_BYTES = 96 << 20

#: Files of Linux with the free memory, and with the limits of control groups (which containers are).
_MEMINFO = Path("/proc/meminfo")
_CONTROL_GROUP = Path("/sys/fs/cgroup")

#: Messages of out-of-memory errors that have no type of their own.
_OUT_OF_MEMORY_TEXTS = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "bad_alloc",
    "Cannot allocate memory",
    "can't start new thread",
    "failed to map segment",
)

T = TypeVar("T")

#: A chunk, ``(first_pixel, pixels, first_sample, samples)``: two numbers of consecutive pixels, and of samples of each of them.
Span = tuple[int, int, int, int]


# -- used and free memory


class MemoryMeter:
    """Memory in use on a device, in bytes: resident pages of the process on a CPU, tensors on CUDA.

    Args:
        device: the device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def now(self) -> int:
        """Return the memory in use now."""
        if self.device.type == "cuda":
            return torch.cuda.memory_allocated(self.device)
        return _process_memory("VmRSS:")

    def peak(self) -> int:
        """Return the largest memory that was ever in use."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device)
        return _process_memory("VmHWM:")

    def base(self) -> int:
        """Return the memory that belongs to no render: that after import, 0 on CUDA."""
        return 0 if self.device.type == "cuda" else after_import()

    def above(self) -> int:
        """Return the memory in use now above :meth:`base`."""
        return max(self.now() - self.base(), 0)


@cache
def after_import() -> int:
    """Return the memory of the process after import, in bytes: measured by the first call, before a scene is loaded."""
    return _process_memory("VmRSS:")


def _process_memory(key: str) -> int:
    """Return a value of ``/proc/self/status`` in bytes; elsewhere the peak memory, or 0 if that is unknown.

    Args:
        key: "VmRSS:" for the resident memory now, "VmHWM:" for its peak.
    """
    try:
        with open("/proc/self/status", "rb") as file:
            for line in file:
                if line.startswith(key.encode()):  # such as "VmRSS:     5432 kB"
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # macOS counts in bytes, others in kB


def mb(size: float) -> str:
    """Return a number of bytes in megabytes, rounded up: ``37MB``."""
    return f"{-int(-size // 1_000_000)}MB"  # floor division of the negative rounds up


def free_memory(device: torch.device) -> int | None:
    """Return the free memory in bytes, on a CPU the lesser of machine and container; None if unknown."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        # torch's allocator keeps freed memory for itself.
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    sizes = [size for size in (_free_in_machine(), _free_in_control_group()) if size is not None]
    return min(sizes, default=None)


def _free_in_machine() -> int | None:
    try:
        lines = _MEMINFO.read_text().splitlines()  # such as "MemAvailable:   12345 kB"
        return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
    except (OSError, ValueError, IndexError):
        return None


def _free_in_control_group() -> int | None:
    """Return the bytes that the limit of a control group (version 2) leaves; its file cache counts as free."""
    try:
        limit = int((_CONTROL_GROUP / "memory.max").read_text())
        taken = int((_CONTROL_GROUP / "memory.current").read_text())
        statistics = dict(line.split() for line in (_CONTROL_GROUP / "memory.stat").read_text().splitlines())
        return limit - taken + int(statistics.get("inactive_file", 0))
    except (OSError, ValueError):  # no such group, or no limit ("max")
        return None


def check_address_space(size: int = CODE_BYTES) -> None:
    """Raise if the process cannot get ``size`` more bytes of address space.

    Called before libraries that abort the process where they cannot (LLVM, OpenMP, BLAS).

    Raises:
        MemoryError: the system refuses.
    """
    try:
        mmap.mmap(-1, size).close()
    except (OSError, MemoryError, ValueError):
        raise MemoryError(f"no room for {mb(size)}") from None


# -- releasing memory

_cache_releasers: list[Callable[[], object]] = []


def on_low_memory(release: Callable[[], object]) -> None:
    """Register a function that drops cached memory; :func:`release_memory` calls it."""
    _cache_releasers.append(release)


def release_memory() -> None:
    """Free caches, reference cycles, and the memory that allocators keep."""
    for release in _cache_releasers:
        release()
    gc.collect()
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim_heap()


def trim_heap() -> None:
    """Give freed memory of the heap back to the system, where the C library can."""
    trim = _malloc_trim()
    if trim is not None:
        trim(0)  # bytes to keep at the top of the heap


@cache
def _malloc_trim() -> ctypes._NamedFuncPointer | None:
    """Return glibc's ``malloc_trim``; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return None


# -- running out of memory


def is_out_of_memory(error: BaseException) -> bool:
    """Return True if an error or one of its causes says that memory ran out, on any device."""
    if isinstance(error, TorchptError):  # already reported
        return False
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, MemoryError | torch.cuda.OutOfMemoryError):
            return True
        if isinstance(cause, OSError) and cause.errno == errno.ENOMEM:
            return True
        if isinstance(cause, RuntimeError | ImportError | OSError) and any(
            text in str(cause) for text in _OUT_OF_MEMORY_TEXTS
        ):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


def fits_in_memory(work: Callable[[], object]) -> bool:
    """Call ``work``; return False if memory ran out. The error is dropped, as its traceback holds the memory of the work."""
    try:
        work()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        return False
    return True


@contextmanager
def explain_out_of_memory(what: str | Callable[[], str]) -> Iterator[None]:
    """Turn out-of-memory errors within into a line that names ``what`` memory was for: a text, or a function that returns it.

    Raises:
        RenderError: memory ran out.
    """
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
    else:
        return
    # Outside of the except block: the dropped error's traceback held memory, which what() may need.
    subject = what if isinstance(what, str) else what()
    raise RenderError(
        f"not enough memory for {subject}, with {mb(MemoryMeter(torch.device('cpu')).above())} held already"
    )


def retry_out_of_memory(what: str | Callable[[], str], work: Callable[[], T]) -> T:
    """Return ``work()``; if memory runs out, release memory and try once more.

    Args:
        what: names, in the error, what memory is for, as :func:`explain_out_of_memory`.
        work: the function.

    Raises:
        RenderError: memory ran out again.
    """
    results: list[T] = []
    if not fits_in_memory(lambda: results.append(work())):
        release_memory()
        with explain_out_of_memory(what):
            return work()
    return results[0]


# -- limits


def check_limit(limit: int, least: int, expected: str) -> None:
    """Raise if ``render.max_memory`` is too small.

    Args:
        limit: ``render.max_memory`` in bytes.
        least: the least limit in bytes.
        expected: says in the error what is accepted.

    Raises:
        SceneError: it is too small.
    """
    if limit >= least:
        return
    if limit >= 1_000_000:
        raise SceneError("render.max_memory", mb(limit), expected)
    # A number below a megabyte was probably not meant in bytes.
    raise SceneError("render.max_memory", f"{limit} bytes", f"{expected}, as bytes or with a unit such as 4GB")


def check_memory(limit: int, device: torch.device, least: Callable[[int], int], loading: int) -> None:
    """Raise if nothing can be rendered within a limit.

    Args:
        limit: ``render.max_memory`` in bytes.
        device: the device of the lanes.
        least: returns the least limit in bytes, given the bytes in use above :meth:`MemoryMeter.base`.
        loading: peak bytes above that base while the scene was loaded; 0 if unknown.

    Raises:
        SceneError: the limit is too small; the message gives the least.
    """
    release_memory()
    enough = max(least(MemoryMeter(device).above()), loading)
    check_limit(limit, enough, f"at least {mb(enough)} for this scene and film")


class Budget:
    """Threads of one job, and lanes of each, that fit in memory.

    Args:
        device: the device of the lanes.
        lanes: largest number of lanes of a thread.
        threads: largest number of threads.
        what: names, in the error, what does not fit even with the fewest lanes of one thread.
        fallback: tells the user how the job goes on after memory ran out.
        limit: ``render.max_memory`` in bytes if the memory of lanes is to be measured; else None.
        bytes_per_lane: expected bytes of a lane, until it is measured; above 0 where there is a ``limit``.
        min_lanes: least number of lanes.

    Attributes:
        threads: current number of threads.
        lanes: current number of lanes of a thread.
        has_shrunk: True once memory ran out.
        limit: largest memory of the process in bytes (that after import included); None if lanes are not measured.

    Raises:
        ValueError: a ``limit`` without ``bytes_per_lane``.
    """

    def __init__(
        self,
        device: torch.device,
        lanes: int,
        threads: int = 1,
        *,
        what: str,
        fallback: str = "waves of fewer lanes",
        limit: int | None = None,
        bytes_per_lane: int = 0,
        min_lanes: int = 1,
    ) -> None:
        if limit is not None and bytes_per_lane <= 0:
            raise ValueError("a limit needs the expected bytes of a lane")
        self.meter, self.threads = MemoryMeter(device), threads
        self.min_lanes, self.bytes_per_lane = min_lanes, bytes_per_lane
        self.what, self.fallback, self.has_shrunk = what, fallback, False
        self.limit = None if limit is None else self.meter.base() + limit
        self._max_lanes = max(lanes, 1)
        self.lanes = self._max_lanes if limit is None else min(FIRST_WAVE_LANES, self._max_lanes)
        self._in_use: int | None = None  # bytes in use after the first wave, without lanes
        self._peak_before = 0  # peak bytes before the wave that runs now

    def fit(self, available: int, bytes_per_lane: int, min_lanes: int) -> None:
        """Set threads and lanes to the most that fit into memory, but at least one thread with ``min_lanes`` lanes.

        Args:
            available: bytes for all lanes.
            bytes_per_lane: bytes of a lane.
            min_lanes: fewest lanes for which a thread is worth its cost.
        """
        for threads in range(self.threads, 0, -1):
            lanes = available // (bytes_per_lane * threads)
            if lanes >= min_lanes or threads == 1:
                self.threads, self.lanes = threads, min(max(lanes, min_lanes), self._max_lanes)
                return

    def drop_unneeded_limit(self) -> None:
        """Drop the limit if all lanes are expected to fit: chunks then have the same size as without one."""
        if self.limit is None or self._max_lanes * self.bytes_per_lane <= WAVE_FRACTION * (
            self.limit - self.meter.now()
        ):
            self.limit, self.lanes = None, self._max_lanes

    def run_in_chunks(self, work: Callable[[Span], object], pixels: int, first: int, count: int) -> Iterator[Span]:
        """Call ``work`` for chunks, each of some samples of some pixels; yield each finished chunk.

        All pixels get their next samples before any gets more. The samples of a pixel are taken in order, so that sums do not
        depend on the chunks.

        Args:
            work: takes all samples of a chunk, or raises and takes none.
            pixels: number of pixels.
            first: number of the first sample of each pixel.
            count: how many samples of each pixel.

        Raises:
            RenderError: not even the fewest lanes fit in memory.
        """
        sample = first
        while sample < first + count:
            samples = max(min(first + count - sample, self.lanes), 1)
            pixel = 0
            while pixel < pixels:
                chunk_pixels = min(max(self.lanes // samples, 1), pixels - pixel)
                yield from self._run_chunk(work, (pixel, chunk_pixels, sample, samples))
                pixel += chunk_pixels
            sample += samples

    def _run_chunk(self, work: Callable[[Span], object], span: Span) -> Iterator[Span]:
        """Take a chunk at once; if memory runs out, in halves. Yield what was taken, in order."""
        stack = [span]
        while stack:
            pixel, pixels, sample, samples = span = stack.pop()
            if pixels * samples <= self.lanes:
                self._before_wave()
                if fits_in_memory(partial(work, span)):
                    self._after_wave(pixels * samples)
                    yield span
                    continue
                self.shrink(pixels * samples)
                if pixels * samples <= self.lanes:  # fewer threads, but as many lanes: the whole chunk again
                    stack.append(span)
                    continue
            # The second half is pushed first, so that the first is popped first.
            half = pixels // 2 if pixels > 1 else samples // 2
            if pixels > 1:
                stack += (pixel + half, pixels - half, sample, samples), (pixel, half, sample, samples)
            else:
                stack += (pixel, pixels, sample + half, samples - half), (pixel, pixels, sample, half)

    def shrink(self, tried_lanes: int | None = None) -> None:
        """After memory ran out, go on with one thread, or with half of the lanes that were tried (None: ``lanes``).

        Raises:
            RenderError: one thread had the fewest lanes already.
        """
        release_memory()
        tried_lanes = self.lanes if tried_lanes is None else tried_lanes
        if self.threads > 1:
            self.threads = 1
        elif tried_lanes <= self.min_lanes:
            raise RenderError(f"not enough memory for {self.what}")
        else:
            self.lanes = max(tried_lanes // 2, self.min_lanes)
        self.limit, self.has_shrunk = None, True  # waves no longer grow
        warn_once(f"torchpt: memory ran out: {self.fallback} from now on, for the same picture")

    # -- measured memory of lanes

    def _before_wave(self) -> None:
        """Record the peak memory before a wave."""
        if self.limit is not None:
            self._peak_before = self.meter.peak()

    def _after_wave(self, taken: int) -> None:
        """Measure a wave of ``taken`` lanes, and decide the size of the next."""
        if self.limit is None:
            return
        if self._in_use is None:
            # The first wave also loaded code, so its peak says nothing about lanes.
            release_memory()
            self._in_use = self.meter.now()
            self._grow(self.limit, self._in_use, UNMEASURED_FACTOR * self.bytes_per_lane, measured=False)
            return
        peak = self.meter.peak()
        # True: this wave set the peak. False: an earlier one did, with at least as much memory.
        measured = peak > self._peak_before
        if measured or (peak <= self.limit and 2 * taken >= self.lanes):  # a small wave below the peak tells nothing
            self._grow(self.limit, self._in_use, max(peak - self._in_use, 1) / taken, measured=measured)

    def _grow(self, limit: int, in_use: int, bytes_per_lane: float, *, measured: bool) -> None:
        """Set lanes to as many as fit.

        Args:
            limit: largest memory of the process in bytes.
            in_use: bytes in use without lanes.
            bytes_per_lane: bytes of a lane.
            measured: True if ``bytes_per_lane`` is that of the last wave, False if it is an upper bound.
        """
        fit = int(WAVE_FRACTION * max(limit - in_use, 0) / bytes_per_lane)
        if measured and self.meter.peak() > limit:
            self.lanes = max(min(fit, self.lanes), 1)
        else:
            growth = MAX_GROWTH * self.lanes if measured else max(fit, 1)
            self.lanes = max(self.lanes, min(fit, growth, self._max_lanes))
