"""Memory: what is held and what is free, how much a job may use, and what is tried when it runs out. The only policy.

A job has some threads, and lanes that each of them takes at once. Under a limit (``render.max_memory``) a :class:`Budget` fits
both to what is left: by what a lane is known to cost (``fit``), or by what lanes before were measured to cost (``through``).
Where an allocation fails all the same, what nobody needs is given back (:func:`release_memory`). Then one thread goes on alone,
then with half as many lanes, and so on (``shrink``). Where not even the fewest fit it is an error of one line.

The limit is about the memory of the process above what it held after import. What is there already (scene, search structure,
world) is measured. What is still to come (films, the picture at the end, code that is loaded) each job foresees.
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

#: Lanes of the first wave under a limit, after which all code is there: what it adds for good is no lane's.
FEWEST = 4096
#: Of what is free, what waves are let to use: what one piece of the picture costs is measured on another.
SHARE = 0.88
#: Waves grow by no more than this from one to the next.
GROWTH = 2
#: Bytes of addresses that libraries may ask for while they make code: some of them end the process where there are none.
MARGIN = 96 << 20

#: Where Linux tells what is free, and what control groups may take.
_MEMINFO = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")

#: What errors of exhausted memory say where their type does not.
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


# -- what is held, and what is free


class MemoryMeter:
    """What is held of a device's memory, in bytes: of the process on a CPU (pages that are really there), of tensors on CUDA.

    Args:
        device: which.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def now(self) -> int:
        """Return what is held at the moment."""
        if self.device.type == "cuda":
            return torch.cuda.memory_allocated(self.device)
        return _status("VmRSS:")

    def peak(self) -> int:
        """Return the most that was ever held."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device)
        return _status("VmHWM:")

    def base(self) -> int:
        """Return what is no part of any render."""
        return 0 if self.device.type == "cuda" else after_import()

    def above(self) -> int:
        """Return what is held above import."""
        return max(self.now() - self.base(), 0)


@cache
def after_import() -> int:
    """Return the bytes that the process held when modules were there; the first call is that moment."""
    return _status("VmRSS:")


def _status(key: str) -> int:
    """Return a line of what Linux tells of the process; elsewhere the peak, which is all that is known; 0 where nothing is."""
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
    """Write a number of bytes as a user would, rounded up: ``37MB``."""
    return f"{-int(-size // 1_000_000)}MB"


def free_memory(device: torch.device) -> int | None:
    """Return the bytes that are free on a device, on a CPU of the machine and its container; None where nobody tells."""
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
    """Return what the limit of a control group (version 2) leaves; what it keeps of files is not counted as taken."""
    try:
        limit = int((_GROUP / "memory.max").read_text())
        taken = int((_GROUP / "memory.current").read_text())
        facts = dict(line.split() for line in (_GROUP / "memory.stat").read_text().splitlines())
        return limit - taken + int(facts.get("inactive_file", 0))
    except (OSError, ValueError):  # no such group, or no limit ("max")
        return None


def check_address_space(size: int = MARGIN) -> None:
    """Refuse to go on where the system would not let the process have so many bytes of addresses more.

    Libraries that end the process where they find none (LLVM, OpenMP, BLAS) are called behind this.

    Raises:
        MemoryError: there is no room.
    """
    try:
        mmap.mmap(-1, size).close()
    except (OSError, MemoryError, ValueError):
        raise MemoryError(f"no room for {mb(size)}") from None


# -- what is given back

_spare: list[Callable[[], object]] = []


def on_low_memory(release: Callable[[], object]) -> None:
    """Register what gives back memory that is kept for later jobs: :func:`release_memory` calls it."""
    _spare.append(release)


def release_memory() -> None:
    """Give back what nobody holds any more: what is kept for later jobs, cycles, what allocators keep."""
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
    """Glibc's ``malloc_trim``; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return None


# -- that it ran out


def is_out_of_memory(error: BaseException) -> bool:
    """Return True where an error, or what it came of, says that there is no more memory, on whatever device."""
    if isinstance(error, TorchptError):  # somebody said so already
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
    """Do work; return False where memory ran out. What the work held is free only once its error is, so none is handed on."""
    try:
        work()
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        return False
    return True


@contextmanager
def explain_out_of_memory(what: str | Callable[[], str]) -> Iterator[None]:
    """Context that says in a line what it was for that there is not enough memory: a text, or what makes one.

    Raises:
        RenderError: there is not.
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
    """Return what work comes to; where memory runs out it is tried again, once what nobody needs is given back.

    Raises:
        RenderError: as :func:`explain_out_of_memory`.
    """
    found: list[T] = []
    if not fits_in_memory(lambda: found.append(work())):
        release_memory()
        with explain_out_of_memory(what):
            return work()
    return found[0]


# -- how much a job may use


def check_limit(limit: int, least: int, expected: str) -> None:
    """Refuse a ``render.max_memory`` of fewer bytes than the least; one below a megabyte was hardly meant in bytes.

    Raises:
        SceneError: it is too small.
    """
    if limit >= least:
        return
    if limit >= 1_000_000:
        raise SceneError("render.max_memory", mb(limit), expected)
    raise SceneError("render.max_memory", f"{limit} bytes", f"{expected}, as bytes or with a unit such as 4GB")


def check_memory(limit: int, device: torch.device, least: Callable[[int], int], loading: int) -> None:
    """Refuse a limit under which nothing can be rendered.

    Args:
        limit: ``render.max_memory``.
        device: where lanes live.
        least: from what is held above import to the least limit.
        loading: the most that was held above import while the scene was made; 0 where it is not known.

    Raises:
        SceneError: it is too small; says the least that is not.
    """
    release_memory()
    enough = max(least(MemoryMeter(device).above()), loading)
    check_limit(limit, enough, f"at least {mb(enough)} for this scene and film")


class Budget:
    """What one job may use: threads, and lanes that each takes at once.

    Args:
        device: where lanes live.
        lanes: most.
        threads: most.
        what: for which there is too little memory where not even the fewest lanes of one thread fit.
        instead: how the job goes on where memory ran out, as users are told.
        limit: ``render.max_memory``, where lanes are to be measured; None: they need not be.
        per_lane: bytes that a lane is expected to cost until it is measured.
        fewest: lanes without which nothing goes.

    Attributes:
        threads: of the job at the moment.
        lanes: of each at the moment.
        short: whether memory ran out.
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
        self._start: int | None = None  # what was held after the first wave
        self._before = 0

    def fit(self, left: int, per_lane: int, least: int) -> None:
        """Take as many threads, and lanes of each, as fit into so many bytes; one thread with the least lanes always does.

        Args:
            left: the bytes.
            per_lane: what one costs.
            least: lanes that repay a thread.
        """
        for threads in range(self.threads, 0, -1):
            lanes = left // (per_lane * threads)
            if lanes >= least or threads == 1:
                self.threads, self.lanes = threads, min(max(lanes, least), self._most)
                return

    def drop_unneeded_limit(self) -> None:
        """Forget the limit where all lanes are expected to fit: then pieces are of the same size with it and without."""
        if self.limit is None or self._most * self.per_lane <= SHARE * (self.limit - self.meter.now()):
            self.limit, self.lanes = None, self._most

    def through(self, work: Callable[[Span], object], pixels: int, first: int, count: int) -> Iterator[Span]:
        """Take samples ``first .. first + count`` of all pixels, piece by piece; yield each once it is done.

        Pieces split pixels, and samples of one pixel stay in their order, so that sums do not depend on the pieces.

        Args:
            work: takes a piece: all of it, or, where it raises, nothing.
            pixels: how many.
            first: sample.
            count: samples of each.

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
        """Take a piece at once, or in halves of halves."""
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
        """Memory ran out: go on with one thread, or with half as many lanes as were tried (None: as there are).

        Raises:
            RenderError: there were but one thread and the fewest lanes.
        """
        release_memory()
        tried = self.lanes if tried is None else tried
        if self.threads > 1:
            self.threads = 1
        elif tried <= self.fewest:
            raise RenderError(f"not enough memory for {self.what}")
        else:
            self.lanes = max(tried // 2, self.fewest)
        self.limit, self.short = None, True  # waves do not grow any more
        warn_once(f"torchpt: memory ran out: {self.instead} from now on, for the same picture")

    # -- what lanes cost, measured

    def _begins(self) -> None:
        """Note that a wave begins."""
        if self.limit is not None:
            self._before = self.meter.peak()

    def _ended(self, taken: int) -> None:
        """Note that a wave of ``taken`` lanes ended, and decide how many the next may have."""
        if self.limit is None:
            return
        if self._start is None:
            release_memory()
            self._start = self.meter.now()
            self._grow(self.limit, self._start, 4 * self.per_lane, False)
            return
        peak = self.meter.peak()
        rose = peak > self._before
        if rose or (peak <= self.limit and 2 * taken >= self.lanes):  # else nothing is known of this wave
            self._grow(self.limit, self._start, max(peak - self._start, 1) / taken, rose)

    def _grow(self, limit: int, start: int, cost: float, rose: bool) -> None:
        """Take as many lanes as fit at a cost that was measured where memory ``rose``, and else is guessed from above."""
        fit = int(SHARE * max(limit - start, 0) / cost)
        if rose and self._before > 0 and self.meter.peak() > limit:
            self.lanes = max(min(fit, self.lanes), 1)
        else:
            self.lanes = max(self.lanes, min(fit, GROWTH * self.lanes if rose else max(fit, 1), self._most))
