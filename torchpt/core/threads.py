"""Threads: the one pool of the process, who is dealt which task, and what torch is set to while they work.

A thread of the pool waits until somebody has work for it. Whoever needs threads takes as many as wait and starts the others, so
renders that overlap never wait for each other's threads. Three ways to use them: :func:`map_in_order` runs a task for each item and
hands over what they come to in the order of items; a :class:`TaskQueue` takes tasks from a list that grows; :func:`parallel_for` cuts a
range into a part for each thread. No idle thread lives while the process forks, and a child has a pool of its own.

On a CPU torch cuts a tensor of more than 32,768 elements into a part for each of its own threads. The last elements of a part
fill no vector, and where another function computes those than computes vectors (``atan2``, ``pow``) they round differently. A
sum over all elements becomes a sum of the threads' own. :func:`map_in_pieces`, :func:`sum_all` and :func:`mean_all` give on any
number of threads what one thread alone computes.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

import torch
from torch import Tensor

from torchpt.core.errors import RenderError
from torchpt.core.memory import check_address_space, fits_in_memory

__all__ = [
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

#: Seconds after which a thread that waits for others looks whether it is to end.
PATIENCE = 0.05
#: Elements that one thread computes alone: fewer than torch divides, and a whole number of the vectors of any CPU.
PIECE = 1 << 14
#: Numbers of a tensor that torch leaves to one thread.
_GRAIN = 32_768
#: Bytes of addresses that a thread may ask for: its stack, and some to spare.
_STACK = 12 << 20
#: What torch hands over to MKL's vector mathematics.
_FUNCTIONS = "acos asin atan cos erf erfc erfinv exp log log10 log2 sin sqrt tan tanh trunc".split()


# -- the pool


class _Thread:
    """A thread of the pool, in which torch uses no other; RuntimeError or MemoryError where there is no memory for it.

    A team of OpenMP in each would stay for as long as the thread does, and make every other team wait instead of spin.
    """

    def __init__(self) -> None:
        self.given = SimpleQueue[tuple[Callable[[], object], SimpleQueue[None]] | None]()
        self.thread = threading.Thread(target=self._run, name=f"torchpt_{next(_numbers)}", daemon=True)
        self._ready = SimpleQueue[None]()
        with _starting:
            count = torch.get_num_threads()
            self.thread.start()
            self._ready.get()
            torch.set_num_threads(count)  # what threads that are yet to come begin with is the process's

    def _run(self) -> None:
        try:
            torch.get_num_threads()  # a thread takes the process's number when it first asks for it
            torch.set_num_threads(1)
        finally:
            self._ready.put(None)
        while (given := self.given.get()) is not None:
            work, ended = given
            work()
            del given, work  # what it held is free
            _idle.append(self)
            ended.put(None)


_numbers = itertools.count()
#: Threads are started one by one: each changes the process's number for a moment.
_starting = threading.Lock()
#: Threads that wait for work.
_idle: list[_Thread] = []


def _run_in_pool(work: Callable[[], object], ended: SimpleQueue[None]) -> bool:
    """Give work, which raises nothing, to a thread of the pool; return False where there is no memory for one."""
    try:
        thread = _idle.pop()
    except IndexError:
        try:
            thread = _Thread()
        except (RuntimeError, MemoryError):
            return False
    thread.given.put((work, ended))
    return True


def _before_fork() -> None:
    """End idle threads: a child would not have them."""
    ending = []
    while _idle:
        ending.append(_idle.pop())
    for thread in ending:
        thread.given.put(None)
    for thread in ending:
        thread.thread.join()


def _after_fork() -> None:
    """Forget threads: a child has none of its parent's, torch's included, and waiting for those would never end."""
    global _torch_threads, _starting
    _idle.clear()
    _starting = threading.Lock()
    _torch_threads = _TorchThreads(forked=True)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_child=_after_fork)


class TaskQueue(Generic[T, R]):
    """Threads of the pool that take tasks from one list, which may grow.

    Args:
        threads: most; fewer where there is no memory for them.

    Attributes:
        threads: likewise.
        pending: tasks in the list or being done, and those that nobody asked for with ``next``.
    """

    def __init__(self, threads: int) -> None:
        self.threads, self.pending = threads, 0
        self._todo = SimpleQueue[tuple[T, Callable[[], R]] | None]()
        self._done = SimpleQueue[tuple[T, R | BaseException]]()
        self._ended = SimpleQueue[None]()
        self._size = 0

    def add(self, tag: T, task: Callable[[], R]) -> None:
        """Put a task at the end of the list; ``tag`` comes back with what it comes to.

        Raises:
            RenderError: there is no memory for a single thread.
        """
        self.pending += 1
        self._todo.put((tag, task))
        if self._size >= min(self.threads, self.pending):
            return
        if _run_in_pool(self._work, self._ended):
            self._size += 1
        elif self._size:
            self.threads = self._size
        else:
            raise RenderError("not enough memory for a thread that renders")

    def next(self, wait: bool) -> tuple[T, R | BaseException] | None:
        """Return what a task came to, or raised; None where nothing came, after a while where it waits."""
        try:
            found = self._done.get(timeout=PATIENCE) if wait else self._done.get_nowait()
        except Empty:
            return None
        self.pending -= 1
        return found

    def close(self) -> None:
        """Let go of the threads once their tasks are done; those that were not begun are dropped."""
        try:
            while True:
                self._todo.get_nowait()
        except Empty:
            pass
        for _ in range(self._size):
            self._todo.put(None)
        while self._size:
            self._ended.get()
            self._size -= 1

    def _work(self) -> None:
        while (job := self._todo.get()) is not None:
            tag, task = job
            try:
                self._done.put((tag, task()))
            except BaseException as error:
                self._done.put((tag, error))
            del job, tag, task


def map_in_order(
    items: Iterable[T],
    task: Callable[[T], R],
    threads: int,
    each: Callable[[R | None], bool],
    halt: threading.Event | None = None,
    ahead: int | None = None,
) -> None:
    """Do a task for each item on threads of the pool; what they come to is handed over in the order of items.

    Args:
        items: taken one by one.
        task: called in a thread of the pool; the calling thread does none, and looks after signals.
        threads: most.
        each: called in this thread with what every task came to, and now and then with None while tasks are done; returning
            True ends it.
        halt: set by whoever wants it to end, and here where ``each`` says so or something raises. No task is begun then, and
            ``task`` may look at it to end early.
        ahead: tasks that are begun before the oldest of them was handed over, at most; None: any number.

    Raises:
        RenderError: there is no memory for a single thread.
        Exception: what a task or ``each`` raised; of several tasks the first one in order.
    """
    halt = halt or threading.Event()
    queue, left = TaskQueue[int, R](threads), enumerate(items)
    found: dict[int, R | BaseException] = {}
    begun = delivered = 0

    def tell() -> None:
        """Hand over what is next, as far as it is there."""
        nonlocal delivered
        while delivered in found:
            result = found.pop(delivered)
            delivered += 1
            if isinstance(result, BaseException):
                try:
                    raise result
                finally:  # or the error would hold this frame, which holds the error with all that the task had
                    del result
            if each(result):
                halt.set()

    try:
        while not halt.is_set():
            while ahead is None or begun - delivered < ahead:
                item = next(left, None)
                if item is None:
                    break
                queue.add(item[0], functools.partial(task, item[1]))
                begun += 1
            if delivered == begun:
                return
            came = queue.next(wait=True)
            if came is not None:
                found[came[0]] = came[1]
            tell()
            if came is None and each(None):
                halt.set()
    except BaseException:
        halt.set()
        raise
    finally:
        queue.close()
    while (came := queue.next(wait=False)) is not None:  # of tasks that were on their way
        found[came[0]] = came[1]
    late = [found[number] for number in sorted(found)]
    for result in late:
        if not isinstance(result, BaseException):
            each(result)
    for result in late:
        if isinstance(result, BaseException):
            raise result


def parallel_for(work: Callable[[int, int], object], items: int, threads: int) -> None:
    """Call ``work(first, last)`` for parts of ``range(items)``, one for each thread; the first in the calling one.

    Args:
        work: machine code that releases the GIL.
        items: how many there are.
        threads: 1 runs strictly in the calling thread.
    """
    if threads == 1:
        work(0, items)
        return
    parts = deque(pairwise(items * k // threads for k in range(threads + 1)))
    errors: list[BaseException] = []

    def take() -> None:
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
    first = parts.popleft()
    helpers = sum(_run_in_pool(take, ended) for _ in range(threads - 1))
    try:
        work(*first)
        take()  # what nobody has begun
    finally:
        for _ in range(helpers):
            ended.get()
    if errors:
        raise errors[0]


# -- torch's own threads, and its modes


def thread_count(threads: int | None) -> int:
    """Return the threads to use: the caller's wish, else torch's own number."""
    return max(1, int(threads)) if threads else max(1, torch.get_num_threads())


class _TorchThreads:
    """The thread count that renders found, and how many of them run."""

    def __init__(self, forked: bool) -> None:
        self.forked, self.lock = forked, threading.Lock()
        self.before, self.renders = 0, 0

    def enter(self, threads: int | str) -> None:
        with self.lock:
            if self.renders == 0:
                self.before = torch.get_num_threads()
            self.renders += 1
            # The thread pool of the parent does not survive a fork: waiting for it would never end.
            now = 1 if self.forked else self.before if threads == "auto" else int(threads)
            if now != torch.get_num_threads():
                torch.set_num_threads(now)
            start_torch_threads()

    def leave(self) -> None:
        with self.lock:
            self.renders -= 1
            # Of renders that overlap, the last one puts back what the first one found.
            if self.renders == 0 and torch.get_num_threads() != self.before and not self.forked:
                torch.set_num_threads(self.before)


#: Of the process, as the thread count is.
_torch_threads = _TorchThreads(forked=False)


@contextmanager
def limited_threads(threads: int | str) -> Iterator[None]:
    """Let torch use ``threads`` threads for a while, in renders that may overlap."""
    here = _torch_threads
    here.enter(threads)
    try:
        yield
    finally:
        if here is _torch_threads:  # else this is the child of a fork, where another thread may have held the lock
            here.leave()


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use a single thread for a while, where what it sums cannot be reached."""
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
    """Call the vector functions once, before several threads do.

    MKL finds out at its first call which code suits the processor. Two threads that find it out together may compute half a
    tensor by less exact code: then the same render gave other bits now and then.
    """
    for dtype in (torch.float32, torch.float64):
        half = torch.full((1,), 0.5, dtype=dtype)
        for name in _FUNCTIONS:
            getattr(torch, name)(half)


#: Numbers of threads that were started, by the thread that renders.
_started: set[int] = set()


def start_torch_threads() -> None:
    """Start torch's threads for the calling one while there is memory for them; where there is not, it renders alone.

    OpenMP ends the process where it cannot start a thread, which it does at the first large tensor, however late that is.
    """
    count = torch.get_num_threads()
    if count > 1 and count not in _started:
        if fits_in_memory(lambda: check_address_space(count * _STACK)):
            torch.zeros(count * _GRAIN).add_(1.0)
            _started.add(count)
        else:
            torch.set_num_threads(1)


@contextmanager
def outside_inference_mode() -> Iterator[None]:
    """What is made here can be used outside of ``torch.inference_mode`` too: tensors made in that mode could not."""
    if torch.is_inference_mode_enabled():
        with torch.inference_mode(False), torch.no_grad():  # the former alone would turn gradients on
            yield
    else:
        yield


@contextmanager
def without_autocast(device: torch.device) -> Iterator[None]:
    """No gradients, no ``torch.autocast`` (which would round products to half precision), and what is made lasts."""
    with outside_inference_mode(), torch.no_grad(), torch.autocast(device.type, enabled=False):
        yield


# -- what does not depend on the number of threads


def map_in_pieces(function: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """Return ``function`` of each element of tensors of one shape."""
    first = given[0]
    if first.device.type != "cpu" or first.numel() <= PIECE:
        return function(*given)
    pieces = [function(*piece) for piece in zip(*(x.reshape(-1).split(PIECE) for x in given), strict=True)]
    return torch.cat(pieces).view(first.shape)


def sum_all(x: Tensor) -> Tensor:
    """Return the sum ``()`` of all elements."""
    # Of two sums at once each is one thread's.
    return x.expand(2, *x.shape).sum(tuple(range(1, x.dim() + 1)))[0]


def mean_all(x: Tensor) -> Tensor:
    """Return the mean ``()`` of all elements."""
    return x.expand(2, *x.shape).mean(tuple(range(1, x.dim() + 1)))[0]
