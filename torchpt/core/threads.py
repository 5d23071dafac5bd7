"""Threads: the thread pool of the process, and torch's number of threads and modes while it works.

A caller takes idle threads of the pool and starts the missing ones, so overlapping renders never wait for each other's threads.
There are four ways to use them: :func:`map_in_order` runs a task for each item and passes results on in the order of items; a
:class:`TaskQueue` runs tasks of a queue that may grow; :func:`parallel_for` splits a range into a part for each thread;
:class:`ReadAhead` makes calls before their results are asked for. Idle threads end before the process forks; a child has a
pool of its own.

On a CPU torch splits a tensor of more than 32,768 elements among its threads. The last elements of a part do not fill a vector,
and functions whose scalar code differs from their vector code (``atan2``, ``pow``) round them differently. A sum over all
elements becomes a sum of the threads' sums. :func:`map_in_pieces`, :func:`sum_all` and :func:`mean_all` have on any number of
threads the bits of one thread.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from itertools import pairwise
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.core.memory import check_address_space, fits_in_memory

__all__ = [
    "ReadAhead",
    "TaskQueue",
    "limited_threads",
    "map_in_order",
    "map_in_pieces",
    "mean_all",
    "one_thread",
    "outside_inference_mode",
    "parallel_for",
    "start_torch_threads",
    "sum_all",
    "thread_count",
    "warm_up",
    "without_autocast",
]

T = TypeVar("T")
R = TypeVar("R")

#: Seconds between two checks of a waiting thread whether it is to stop.
POLL_SECONDS = 0.05
#: Elements of a piece that one thread computes: fewer than torch splits, and a multiple of the vectors of any CPU.
PIECE = 1 << 14
#: Elements up to which torch uses one thread (``at::internal::GRAIN_SIZE``).
_TORCH_GRAIN = 32_768
#: Bytes of address space that a thread needs: a stack of 8 MiB, the default of Linux, and a margin.
_THREAD_BYTES = 12 << 20
#: Functions that torch computes by MKL's vector math.
_MKL_FUNCTIONS = "acos asin atan cos erf erfc erfinv exp log log10 log2 sin sqrt tan tanh trunc".split()


# -- the pool


class _Thread:
    """A thread of the pool, in which torch is single-threaded.

    With more, each would have a team of OpenMP threads as long as it lives, and every other team would sleep instead of spin.

    Attributes:
        inbox: pairs of a function to call, and a queue that gets None once it has returned; None ends the thread.

    Raises:
        RuntimeError: the thread cannot be started.
        MemoryError: as above.
    """

    def __init__(self) -> None:
        self.inbox = SimpleQueue[tuple[Callable[[], object], SimpleQueue[None]] | None]()
        self.thread = threading.Thread(target=self._run, name=f"torchpt_{next(_numbers)}", daemon=True)
        self._ready = SimpleQueue[None]()
        with _start_lock:
            count = torch.get_num_threads()
            self.thread.start()
            self._ready.get()
            # set_num_threads(1) of the new thread changed the number that further threads of the process begin with.
            torch.set_num_threads(count)

    def _run(self) -> None:
        try:
            torch.get_num_threads()  # the first call makes the thread inherit the process's number
            torch.set_num_threads(1)
            _of_pool.set(True)
        finally:
            self._ready.put(None)
        while (message := self.inbox.get()) is not None:
            work, ended = message
            work()
            del message, work  # an idle thread keeps nothing alive
            _idle.append(self)  # before the caller hears of the end, so that it finds this thread idle
            ended.put(None)


#: True in threads of the pool.
_of_pool: ContextVar[bool] = ContextVar("of_pool", default=False)
#: Numbers for the names of threads.
_numbers = itertools.count()
#: Serializes starts of threads: each changes torch's number of threads for a moment.
_start_lock = threading.Lock()
#: Idle threads.
_idle: list[_Thread] = []


def _run_in_pool(work: Callable[[], object], ended: SimpleQueue[None]) -> bool:
    """Run ``work``, which must not raise, on a thread of the pool, which then puts None into ``ended``.

    Returns:
        False if no thread can be started.
    """
    try:
        thread = _idle.pop()
    except IndexError:
        try:
            thread = _Thread()
        except (RuntimeError, MemoryError):
            return False
    thread.inbox.put((work, ended))
    return True


def _before_fork() -> None:
    """End idle threads before a fork: the child would not have them."""
    ending = []
    while _idle:
        ending.append(_idle.pop())
    for thread in ending:
        thread.inbox.put(None)
    for thread in ending:
        thread.thread.join()


def _after_fork() -> None:
    """Forget all threads after a fork: the child has neither its parent's nor torch's, and would wait forever.

    Torch, too, is set to one thread, as in the workers of its data loaders: the OpenMP threads of its pool are the parent's.
    """
    global _torch_threads, _start_lock
    torch.set_num_threads(1)
    _idle.clear()
    _start_lock = threading.Lock()  # another thread may have held the old one during the fork
    _torch_threads = _TorchThreads(forked=True)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_child=_after_fork)


class TaskQueue(Generic[T, R]):
    """Threads of the pool that run the tasks of one queue.

    Args:
        threads: largest number of threads; fewer run if memory is short.

    Attributes:
        threads: largest number of threads; lowered once no more can be started.
        pending: number of tasks that are queued or running, or whose results ``next`` has not returned.
    """

    def __init__(self, threads: int) -> None:
        self.threads, self.pending = threads, 0
        self._todo = SimpleQueue[tuple[T, Callable[[], R]] | None]()
        self._done = SimpleQueue[tuple[T, R | BaseException]]()
        self._ended = SimpleQueue[None]()
        self._started = 0  # threads that work for this queue

    def add(self, tag: T, task: Callable[[], R]) -> None:
        """Queue a task; ``next`` returns ``tag`` with its result.

        Raises:
            RenderError: there is no memory for a single thread.
        """
        self.pending += 1
        self._todo.put((tag, task))
        if self._started >= min(self.threads, self.pending):
            return
        if _run_in_pool(self._work, self._ended):
            self._started += 1
        elif self._started:
            self.threads = self._started
        else:
            raise RenderError("not enough memory for a thread that renders")

    def next(self, *, wait: bool) -> tuple[T, R | BaseException] | None:
        """Return tag and result (or exception) of a finished task, or None: at once, or after ``POLL_SECONDS`` if ``wait``."""
        try:
            finished = self._done.get(timeout=POLL_SECONDS) if wait else self._done.get_nowait()
        except Empty:
            return None
        self.pending -= 1
        return finished

    def close(self) -> None:
        """Drop queued tasks, and return the threads to the pool once the running ones are finished."""
        try:
            while True:
                self._todo.get_nowait()
        except Empty:
            pass
        for _ in range(self._started):
            self._todo.put(None)
        while self._started:
            self._ended.get()
            self._started -= 1

    def _work(self) -> None:
        """Run tasks until None comes (on a thread of the pool)."""
        while (entry := self._todo.get()) is not None:
            tag, task = entry
            try:
                self._done.put((tag, task()))
            except BaseException as error:
                self._done.put((tag, error))
            del entry, tag, task  # keeps nothing alive while it waits


def map_in_order(
    items: Iterable[T],
    task: Callable[[T], R],
    threads: int,
    on_result: Callable[[R | None], bool],
    halt: threading.Event | None = None,
    ahead: int | None = None,
    here: bool = False,
) -> None:
    """Run a task for each item on threads of the pool, and pass the results on in the order of items.

    Args:
        items: items, taken one by one.
        task: is called in a thread of the pool; the calling thread only handles results and signals.
        threads: largest number of threads.
        on_result: is called in this thread with every result, and every ``POLL_SECONDS`` with None while tasks run; it returns
            True to end the work.
        halt: set from outside to end the work, and here after ``on_result`` returned True or something raised. Then no task
            starts, and a running ``task`` may check it to end early.
        ahead: largest number of tasks that start before the oldest one's result was passed on; None: any number.
        here: True: tasks are so few and short that the calling thread runs them, as a thread of the pool would.

    Raises:
        RenderError: there is no memory for a single thread.
        Exception: the exception of a task or of ``on_result``; of several tasks that of the first in order.
    """
    halt = halt or threading.Event()
    if here:
        with one_thread():
            for item in items:
                if halt.is_set():
                    return
                if on_result(task(item)):
                    halt.set()
        return
    queue, numbered_items = TaskQueue[int, R](threads), enumerate(items)
    results: dict[int, R | BaseException] = {}  # not passed on yet, by the number of their item
    begun = delivered = 0  # items whose task was queued; results that were passed on

    def deliver() -> None:
        """Pass on the results that are next in order."""
        nonlocal delivered
        while delivered in results:
            result = results.pop(delivered)
            delivered += 1
            if isinstance(result, BaseException):
                try:
                    raise result
                finally:  # the error's traceback would keep this frame, and this frame the error
                    del result
            if on_result(result):
                halt.set()

    try:
        while not halt.is_set():
            while ahead is None or begun - delivered < ahead:
                numbered = next(numbered_items, None)
                if numbered is None:
                    break
                number, item = numbered
                queue.add(number, functools.partial(task, item))
                begun += 1
            if delivered == begun:
                return
            finished = queue.next(wait=True)
            if finished is not None:
                number, results[number] = finished
            deliver()
            if finished is None and on_result(None):
                halt.set()
    except BaseException:
        halt.set()
        raise
    finally:
        queue.close()
    # Halted without an error: results of tasks that were running are passed on too, then errors among them raised.
    while (finished := queue.next(wait=False)) is not None:
        number, results[number] = finished
    late = [results[number] for number in sorted(results)]
    for result in late:
        if not isinstance(result, BaseException):
            on_result(result)
    for result in late:
        if isinstance(result, BaseException):
            raise result


def parallel_for(work: Callable[[int, int], object], items: int, threads: int, parts_per_thread: int = 1) -> None:
    """Call ``work(first, last)`` for equal parts ``range(first, last)`` of ``range(items)``, the first in this thread.

    Args:
        work: machine code that releases the GIL.
        items: length of the range.
        threads: number of threads; 1 runs strictly in the calling thread.
        parts_per_thread: number of parts a thread: threads that are done with theirs take others, if the cost of items varies.
    """
    if threads == 1:
        work(0, items)
        return
    count = threads * parts_per_thread
    parts = deque(pairwise(items * k // count for k in range(count + 1)))  # (first, last), last excluded
    errors: list[BaseException] = []

    def work_on_parts() -> None:
        while True:
            try:
                part = parts.popleft()
            except IndexError:
                return
            try:
                work(*part)
            except BaseException as error:
                errors.append(error)

    ended = SimpleQueue[None]()
    own_part = parts.popleft()
    started = sum(_run_in_pool(work_on_parts, ended) for _ in range(threads - 1))
    try:
        work(*own_part)
        work_on_parts()  # those that no other thread has begun
    finally:
        for _ in range(started):
            ended.get()
    if errors:
        raise errors[0]


class ReadAhead:
    """Calls that threads of the pool make before their results are asked for; a context, which waits for these threads.

    A call that no thread has begun is made where its result is asked for, so with one thread all of them are.

    Args:
        threads: number of threads, the caller's included.
    """

    def __init__(self, threads: int) -> None:
        self._most = threads - 1
        self._working = self._started = 0  # threads that take calls now; those that ever did
        self._todo, self._lock = deque[Callable[[], object]](), threading.Lock()
        self._ended = SimpleQueue[None]()

    def add(self, call: Callable[[], R]) -> Callable[[], R]:
        """Queue a call; return a function that returns its result or raises its exception."""
        once = _Once(call)
        with self._lock:
            self._todo.append(once.make)
            more = self._working < self._most
            self._working += more
        if more and _run_in_pool(self._work, self._ended):
            self._started += 1
        return once.result

    def __enter__(self) -> ReadAhead:
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._todo.clear()
        for _ in range(self._started):
            self._ended.get()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._todo:
                    self._working -= 1
                    return
                make = self._todo.popleft()
            make()


class _Once(Generic[R]):
    """A call that is made once, by the first thread that comes."""

    def __init__(self, call: Callable[[], R]) -> None:
        self._lock = threading.Lock()
        self._call: Callable[[], R] | None = call
        self._value: list[R] = []
        self._error: BaseException | None = None

    def make(self) -> None:
        """Make the call, or wait for another thread that is making it."""
        with self._lock:
            if self._call is None:
                return
            try:
                self._value.append(self._call())
            except BaseException as error:
                self._error = error
            self._call = None

    def result(self) -> R:
        """Return the result of the call, or raise its exception."""
        self.make()
        if self._error is not None:
            raise self._error
        return self._value[0]


# -- torch's threads and modes


#: Number of threads of the render that the calling thread works for; None: torch's.
_threads_of_render: ContextVar[int | None] = ContextVar("threads_of_render", default=None)


def thread_count(threads: int | None) -> int:
    """Return the number of threads to use: ``threads``, or that of the render (:func:`limited_threads`), or torch's."""
    return max(1, int(threads or _threads_of_render.get() or torch.get_num_threads()))


class _TorchThreads:
    """Sets torch's number of threads while renders run, which may overlap, and restores it after the last.

    Args:
        forked: True in a process that was forked from one that had imported this package.

    Attributes:
        before: the number before the first of the renders that run now.
        renders: how many run now.
    """

    def __init__(self, *, forked: bool) -> None:
        self.forked, self.lock = forked, threading.Lock()
        self.before, self.renders = 0, 0

    def enter(self, threads: int | str) -> int:
        """Begin a render with a number of threads, or "auto": as many as torch has; return the number."""
        with self.lock:
            if self.renders == 0:
                self.before = torch.get_num_threads()
            self.renders += 1
            # Torch's thread pool does not survive a fork: the child would wait for it forever.
            count = 1 if self.forked else self.before if threads == "auto" else int(threads)
            if count != torch.get_num_threads():
                torch.set_num_threads(count)
            start_torch_threads()
            return torch.get_num_threads()

    def leave(self) -> None:
        """End a render."""
        with self.lock:
            self.renders -= 1
            if self.renders == 0 and torch.get_num_threads() != self.before and not self.forked:
                torch.set_num_threads(self.before)


#: One for the process, as torch's number of threads is.
_torch_threads = _TorchThreads(forked=False)


@contextmanager
def limited_threads(threads: int | str, small: bool = False) -> Iterator[None]:
    """Let torch use ``threads`` threads within, also in overlapping renders; "auto": as many as before.

    Within a thread of the pool there is one thread: others of the pool work beside it.

    Args:
        threads: the number, or "auto".
        small: True: torch itself uses one thread, as its tensors are so small that waking others takes longer than they
            save, above all beside busy processes. :func:`thread_count` is still ``threads``.
    """
    if _of_pool.get():
        yield
        return
    entered = _torch_threads
    token = _threads_of_render.set(entered.enter(threads))
    try:
        with one_thread() if small else nullcontext():
            yield
    finally:
        _threads_of_render.reset(token)
        if entered is _torch_threads:  # otherwise this is the child of a fork, where another thread may hold the lock
            entered.leave()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread within, for sums that :func:`sum_all` cannot replace, and for small tensors."""
    before = torch.get_num_threads()
    if before > 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        if before > 1:
            torch.set_num_threads(before)


@functools.cache
def warm_up() -> None:
    """Call MKL's vector functions once, before several threads do.

    MKL selects code for the processor at its first call. If two threads do so at once, half a tensor may be computed by less
    exact code, and the same render has other bits now and then.
    """
    for dtype in (torch.float32, torch.float64):
        half = torch.full((1,), 0.5, dtype=dtype)
        for name in _MKL_FUNCTIONS:
            getattr(torch, name)(half)


#: Numbers of threads for which torch's team of OpenMP threads was started.
_started_counts: set[int] = set()


def start_torch_threads() -> None:
    """Start torch's threads for the calling thread; without memory for them set torch to one thread.

    OpenMP aborts the process if it cannot start a thread, which happens at the first large tensor.
    """
    count = torch.get_num_threads()
    if count > 1 and count not in _started_counts:
        if fits_in_memory(lambda: check_address_space(count * _THREAD_BYTES)):
            torch.zeros(count * _TORCH_GRAIN).add_(1.0)  # so large that every thread has elements
            _started_counts.add(count)
        else:
            torch.set_num_threads(1)


@contextmanager
def outside_inference_mode() -> Iterator[None]:
    """Leave ``torch.inference_mode`` within: tensors made in that mode cannot be used outside of it."""
    if torch.is_inference_mode_enabled():
        with torch.inference_mode(False), torch.no_grad():  # inference_mode(False) alone enables gradients
            yield
    else:
        yield


@contextmanager
def without_autocast(device: torch.device) -> Iterator[None]:
    """Disable gradients, ``torch.autocast`` (which would round products to half precision) and inference mode."""
    with outside_inference_mode(), torch.no_grad(), torch.autocast(device.type, enabled=False):
        yield


# -- results that do not depend on the number of threads


def map_in_pieces(function: Callable[..., Tensor], *tensors: Tensor) -> Tensor:
    """Return an elementwise ``function`` of tensors of one shape, computed in pieces that torch does not split."""
    first = tensors[0]
    if first.device.type != "cpu" or first.numel() <= PIECE:
        return function(*tensors)
    pieces = [function(*piece) for piece in zip(*(x.reshape(-1).split(PIECE) for x in tensors), strict=True)]
    return torch.cat(pieces).view(first.shape)


def sum_all(x: Tensor) -> Tensor:
    """Return the sum ``()`` of all elements."""
    # Torch splits a single sum among threads; two rows that are summed at once (views of one tensor) it computes in a thread
    # each.
    return x.expand(2, *x.shape).sum(tuple(range(1, x.dim() + 1)))[0]


def mean_all(x: Tensor) -> Tensor:
    """Return the mean ``()`` of all elements."""
    # Two rows, as in sum_all.
    return x.expand(2, *x.shape).mean(tuple(range(1, x.dim() + 1)))[0]
