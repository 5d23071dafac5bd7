"""The time that this process has spent on compiling kernels or loading them from disk."""

from __future__ import annotations

import os
import threading
import time

__all__ = ["begin", "end", "seconds"]

_lock = threading.Lock()
# total: seconds of finished compilations; depth: compilations in progress; since: time at which the first of these began
_state = {"total": 0.0, "since": 0.0, "depth": 0}


def seconds() -> float:
    """Return the seconds so far, including a compilation in progress. Time in which several are in progress counts once."""
    with _lock:
        under_way = time.perf_counter() - _state["since"] if _state["depth"] else 0.0
        return _state["total"] + under_way


def begin() -> None:
    """Mark the start of a compilation in a thread, or of its wait for another thread's."""
    with _lock:
        if not _state["depth"]:
            _state["since"] = time.perf_counter()
        _state["depth"] += 1


def end() -> None:
    """Mark the end of a compilation, or of a wait, that :func:`begin` has marked."""
    with _lock:
        _state["depth"] -= 1
        if not _state["depth"]:
            _state["total"] += time.perf_counter() - _state["since"]


def _after_fork() -> None:
    """Reset the state in a forked child, which has none of the parent's compiling threads."""
    global _lock
    _lock = threading.Lock()
    _state["depth"] = 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
