"""Seconds that this process has spent on kernels that any render may call, compiling them or loading them from disk."""

from __future__ import annotations

import os
import threading
import time

__all__ = ["begin", "end", "seconds"]

_lock = threading.Lock()
_state = {"total": 0.0, "since": 0.0, "depth": 0}


def seconds() -> float:
    """Return the seconds so far, those of a compilation that is under way included; nested or at once they count once."""
    with _lock:
        under_way = time.perf_counter() - _state["since"] if _state["depth"] else 0.0
        return _state["total"] + under_way


def begin() -> None:
    """Note that a thread compiles from now on, or waits for another one that does."""
    with _lock:
        if not _state["depth"]:
            _state["since"] = time.perf_counter()
        _state["depth"] += 1


def end() -> None:
    """Note that a thread that had :func:`begin` is done."""
    with _lock:
        _state["depth"] -= 1
        if not _state["depth"]:
            _state["total"] += time.perf_counter() - _state["since"]


def _after_fork() -> None:
    """Begin anew in a child: threads that compiled are not there."""
    global _lock
    _lock = threading.Lock()
    _state["depth"] = 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
