"""How many threads there are, how they share work, and that their number does not matter."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import torch

from torchpt.native.memory import room_for

__all__ = ["settle", "share", "start_team", "thread_count"]

_lock = threading.Lock()
#: Threads that wait for work, by process and number.
_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}
#: What torch hands over to MKL's vector mathematics.
_FUNCTIONS = "acos asin atan cos erf erfc erfinv exp log log10 log2 sin sqrt tan tanh trunc".split()
#: Numbers of a tensor that torch leaves to one thread.
_GRAIN = 32_768
#: Bytes of addresses that a thread may ask for: its stack, and some to spare.
_STACK = 12 << 20


def thread_count(threads: int | None) -> int:
    """Threads to use: the caller's wish, else torch's own number."""
    return max(1, int(threads)) if threads else max(1, torch.get_num_threads())


def _after_fork() -> None:
    """A child starts without its parent's threads, and without a lock that one of them may hold."""
    global _lock
    _lock = threading.Lock()
    _pools.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def _pool(workers: int) -> ThreadPoolExecutor:
    with _lock:
        key = (os.getpid(), workers)
        if key not in _pools:
            _pools[key] = ThreadPoolExecutor(workers, thread_name_prefix="torchpt")
        return _pools[key]


def share(work: Callable[[int, int], object], items: int, threads: int) -> None:
    """Call ``work(first, last)`` for parts of ``range(items)``, one for each thread; the first in the calling one.

    Args:
        work: machine code that releases the GIL.
        items: how many there are.
        threads: 1 runs strictly in the calling thread.
    """
    if threads == 1:
        work(0, items)
        return
    cuts = [items * k // threads for k in range(threads + 1)]
    pool = _pool(threads - 1)
    jobs = [pool.submit(work, a, b) for a, b in pairwise(cuts[1:])]
    try:
        work(0, cuts[1])
    finally:
        for job in jobs:
            job.result()


@functools.cache
def settle() -> None:
    """Call the vector functions once, before several threads do.

    MKL finds out at its first call which code suits the processor. Two threads that find it out together may compute half a
    tensor by less exact code: then the same render gave other bits now and then.
    """
    for dtype in (torch.float32, torch.float64):
        half = torch.full((1,), 0.5, dtype=dtype)
        for name in _FUNCTIONS:
            getattr(torch, name)(half)


def start_team() -> None:
    """Start torch's threads for the calling one while there is memory for them; where there is not, it renders alone.

    OpenMP ends the process where it cannot start a thread, which it does at the first large tensor, however late that is.
    """
    count = torch.get_num_threads()
    if count > 1 and count not in _started:
        if room_for(count * _STACK):
            torch.zeros(count * _GRAIN).add_(1.0)
            _started.add(count)
        else:
            torch.set_num_threads(1)


#: Numbers of threads that were started, by the thread that renders.
_started: set[int] = set()
