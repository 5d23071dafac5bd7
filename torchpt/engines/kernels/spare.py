"""Workers that no render has at the moment: the next one of the same structure takes them over, as fresh memory costs time."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Hashable

from torchpt.core.memory import when_short
from torchpt.engines.kernels.chunk import Worker

__all__ = ["keep", "taken"]

#: Bytes of all that are kept; the oldest go first.
MOST = 64 << 20

_lock = threading.Lock()
_kept: deque[tuple[Hashable, Worker, int]] = deque()


def keep(structure: Hashable, worker: Worker) -> None:
    """Keep a worker for renders of a structure; it lets go of the render that it was of."""
    size = worker.leave()
    with _lock:
        _kept.append((structure, worker, size))
        total = sum(one[2] for one in _kept)
        while total > MOST:
            total -= _kept.popleft()[2]


def taken(structure: Hashable) -> Worker | None:
    """Return a worker for a render of a structure, the latest; None where there is none."""
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
    """Another thread of the parent may have held the lock."""
    global _lock
    _lock = threading.Lock()


when_short(_release)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
