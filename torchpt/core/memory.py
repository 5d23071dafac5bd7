"""Memory: used and free memory, the limit of a job, and what is done when memory runs out.

A job has threads, each of which traces some lanes at once. Under a limit (``render.max_memory``) a :class:`Budget` chooses both
numbers: by the known size of a lane (``fit``), or by the measured size of earlier ones (``through``). If an allocation fails
all the same, caches are freed (:func:`release_memory`), then one thread goes on alone, then with half as many lanes, and so on
(``shrink``). If the fewest lanes do not fit, a one-line error is raised.

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
    "FEWEST",
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
]

#: Lanes of the first wave under a limit. After it all code is loaded, whose memory must not count as that of lanes.
FEWEST = 4096
#: Share of the free memory for waves: the next one may need more than the measured one.
SHARE = 0.88
#: Largest growth of a wave over the one before.
GROWTH = 2
#: Bytes of address space that libraries may need to make code; some of them abort the process without it.
MARGIN = 96 << 20

#: Files of Linux with the free memory, and with the limits of control groups.
_MEMINFO = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")

#: Messages of out-of-memory errors that have no type of their own.
_SAID = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "bad_alloc",
    "Cannot allocate memory",
    "can't start new thread",
    "failed to map segment",
)

T = TypeVar("T")

#: ``(first_pixel, pixels, first_sample, samples)``
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
        return _status("VmRSS:")

    def peak(self) -> int:
        """Return the largest memory that was ever in use."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device)
        return _status("VmHWM:")

    def base(self) -> int:
        """Return the memory that belongs to no render: that after import, 0 on CUDA."""
        return 0 if self.device.type == "cuda" else after_import()

    def above(self) -> int:
        """Return the memory in use now above :meth:`base`."""
        return max(self.now() - self.base(), 0)


@cache
def after_import() -> int:
    """Return the memory of the process after import, in bytes: it is measured by the first call."""
    return _status("VmRSS:")


def _status(key: str) -> int:
    """Return a value of ``/proc/self/status`` in bytes; elsewhere the peak memory, or 0 if that is unknown."""
    try:
        with open("/proc/self/status", "rb") as file:
            for line in file:
                if line.startswith(key.encode()):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def mb(size: float) -> str:
    """Return a number of bytes in megabytes, rounded up: ``37MB``."""
    return f"{-int(-size // 1_000_000)}MB"


def free_memory(device: torch.device) -> int | None:
    """Return the free memory in bytes, on a CPU that of machine and container; None if unknown."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    found = [size for size in (_of_machine(), _of_group()) if size is not None]
    return min(found, default=None)


def _of_machine() -> int | None:
    try:
        lines = _MEMINFO.read_text().splitlines()
        return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
    except (OSError, ValueError, IndexError):
        return None


def _of_group() -> int | None:
    """Return the memory that the limit of a control group (version 2) leaves; its file cache counts as free."""
    try:
        limit = int((_GROUP / "memory.max").read_text())
        taken = int((_GROUP / "memory.current").read_text())
        facts = dict(line.split() for line in (_GROUP / "memory.stat").read_text().splitlines())
        return limit - taken + int(facts.get("inactive_file", 0))
    except (OSError, ValueError):  # no such group, or no limit ("max")
        return None


def check_address_space(size: int = MARGIN) -> None:
    """Raise if the process cannot get ``size`` more bytes of address space.

    Called before libraries that would abort the process then (LLVM, OpenMP, BLAS).

    Raises:
        MemoryError: the system refuses.
    """
    try:
        mmap.mmap(-1, size).close()
    except (OSError, MemoryError, ValueError):
        raise MemoryError(f"no room for {mb(size)}") from None


# -- releasing memory

_spare: list[Callable[[], object]] = []


def on_low_memory(release: Callable[[], object]) -> None:
    """Register a function that drops cached memory; :func:`release_memory` calls it."""
    _spare.append(release)


def release_memory() -> None:
    """Free caches, reference cycles, and the memory that allocators keep."""
    for release in _spare:
        release()
    gc.collect()
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> ctypes._NamedFuncPointer | None:
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
        if isinstance(cause, RuntimeError | ImportError | OSError) and any(text in str(cause) for text in _SAID):
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
    """Turn out-of-memory errors within into a line that names ``what``: a text, or a function that returns it.

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
    subject = what if isinstance(what, str) else what()
    raise RenderError(
        f"not enough memory for {subject}, with {mb(MemoryMeter(torch.device('cpu')).above())} held already"
    )


def retry_out_of_memory(what: str | Callable[[], str], work: Callable[[], T]) -> T:
    """Return ``work()``; if memory runs out, release memory and try once more.

    Raises:
        RenderError: memory ran out again.
    """
    found: list[T] = []
    if not fits_in_memory(lambda: found.append(work())):
        release_memory()
        with explain_out_of_memory(what):
            return work()
    return found[0]


# -- limits


def check_limit(limit: int, least: int, expected: str) -> None:
    """Raise if ``render.max_memory`` is below ``least`` bytes; a number below a megabyte was probably not meant in bytes.

    Raises:
        SceneError: it is too small.
    """
    if limit >= least:
        return
    if limit >= 1_000_000:
        raise SceneError("render.max_memory", mb(limit), expected)
    raise SceneError("render.max_memory", f"{limit} bytes", f"{expected}, as bytes or with a unit such as 4GB")


def check_memory(limit: int, device: torch.device, least: Callable[[int], int], loading: int) -> None:
    """Raise if nothing can be rendered within a limit.

    Args:
        limit: ``render.max_memory``.
        device: the device of the lanes.
        least: returns the least limit, given the memory in use above import.
        loading: peak memory above import while the scene was loaded; 0 if unknown.

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
        instead: tells the user how the job goes on after memory ran out.
        limit: ``render.max_memory`` if the memory of lanes is to be measured; else None.
        per_lane: expected bytes of a lane, until it is measured.
        fewest: least number of lanes.

    Attributes:
        threads: current number of threads.
        lanes: current number of lanes of a thread.
        short: True once memory ran out.
    """

    def __init__(
        self,
        device: torch.device,
        lanes: int,
        threads: int = 1,
        *,
        what: str,
        instead: str = "waves of fewer lanes",
        limit: int | None = None,
        per_lane: int = 0,
        fewest: int = 1,
    ) -> None:
        self.meter, self.threads, self.fewest, self.per_lane = MemoryMeter(device), threads, fewest, per_lane
        self.what, self.instead, self.short = what, instead, False
        self.limit = None if limit is None else self.meter.base() + limit
        self._most = max(lanes, 1)
        self.lanes = self._most if limit is None else min(FEWEST, self._most)
        self._start: int | None = None  # memory in use after the first wave
        self._before = 0

    def fit(self, left: int, per_lane: int, least: int) -> None:
        """Set threads and lanes to the most that fit into ``left`` bytes, but at least one thread with ``least`` lanes.

        Args:
            left: bytes that are available.
            per_lane: bytes of a lane.
            least: fewest lanes for which a thread is worth its cost.
        """
        for threads in range(self.threads, 0, -1):
            lanes = left // (per_lane * threads)
            if lanes >= least or threads == 1:
                self.threads, self.lanes = threads, min(max(lanes, least), self._most)
                return

    def drop_unneeded_limit(self) -> None:
        """Drop the limit if all lanes are expected to fit: chunks then have the same size as without one."""
        if self.limit is None or self._most * self.per_lane <= SHARE * (self.limit - self.meter.now()):
            self.limit, self.lanes = None, self._most

    def through(self, work: Callable[[Span], object], pixels: int, first: int, count: int) -> Iterator[Span]:
        """Call ``work`` for chunks of samples ``first .. first + count`` of all pixels; yield each finished chunk.

        A chunk has some pixels; samples of a pixel are taken in order, so that sums do not depend on the chunks.

        Args:
            work: takes all samples of a chunk, or raises and takes none.
            pixels: number of pixels.
            first: first sample.
            count: samples of each pixel.

        Raises:
            RenderError: not even the fewest lanes fit in memory.
        """
        sample = first
        while sample < first + count:
            samples = max(min(first + count - sample, self.lanes), 1)
            pixel = 0
            while pixel < pixels:
                n = min(max(self.lanes // samples, 1), pixels - pixel)
                yield from self._whole(work, (pixel, n, sample, samples))
                pixel += n
            sample += samples

    def _whole(self, work: Callable[[Span], object], span: Span) -> Iterator[Span]:
        """Take a chunk at once; if memory runs out, in halves."""
        todo = [span]
        while todo:
            pixel, n, sample, samples = span = todo.pop()
            if n * samples <= self.lanes:
                self._begins()
                if fits_in_memory(partial(work, span)):
                    self._ended(n * samples)
                    yield span
                    continue
                self.shrink(n * samples)
            half = n // 2 if n > 1 else samples // 2
            if n > 1:
                todo += (pixel + half, n - half, sample, samples), (pixel, half, sample, samples)
            else:
                todo += (pixel, n, sample + half, samples - half), (pixel, n, sample, half)

    def shrink(self, tried: int | None = None) -> None:
        """After memory ran out, go on with one thread, or with half of the ``tried`` lanes (None: of the current number).

        Raises:
            RenderError: one thread had the fewest lanes already.
        """
        release_memory()
        tried = self.lanes if tried is None else tried
        if self.threads > 1:
            self.threads = 1
        elif tried <= self.fewest:
            raise RenderError(f"not enough memory for {self.what}")
        else:
            self.lanes = max(tried // 2, self.fewest)
        self.limit, self.short = None, True  # waves no longer grow
        warn_once(f"torchpt: memory ran out: {self.instead} from now on, for the same picture")

    # -- measured memory of lanes

    def _begins(self) -> None:
        """Record the peak memory before a wave."""
        if self.limit is not None:
            self._before = self.meter.peak()

    def _ended(self, taken: int) -> None:
        """Measure a wave of ``taken`` lanes, and decide the size of the next."""
        if self.limit is None:
            return
        if self._start is None:
            release_memory()
            self._start = self.meter.now()
            self._grow(self.limit, self._start, 4 * self.per_lane, False)
            return
        peak = self.meter.peak()
        rose = peak > self._before
        if rose or (peak <= self.limit and 2 * taken >= self.lanes):  # otherwise the wave tells nothing
            self._grow(self.limit, self._start, max(peak - self._start, 1) / taken, rose)

    def _grow(self, limit: int, start: int, cost: float, rose: bool) -> None:
        """Set lanes to as many as fit at ``cost`` bytes each: measured if the peak ``rose``, else an upper bound."""
        fit = int(SHARE * max(limit - start, 0) / cost)
        if rose and self._before > 0 and self.meter.peak() > limit:
            self.lanes = max(min(fit, self.lanes), 1)
        else:
            self.lanes = max(self.lanes, min(fit, GROWTH * self.lanes if rose else max(fit, 1), self._most))
