"""How many threads torch uses while renders run, which may overlap."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from torchpt.native.threads import start_team

__all__ = ["limited_threads"]


class _Wish:
    """The thread count that renders found, and how many of them run."""

    def __init__(self, forked: bool) -> None:
        self.forked, self.lock = forked, threading.Lock()
        self.before, self.renders = 0, 0

    def enter(self, wish: int | str) -> None:
        with self.lock:
            if self.renders == 0:
                self.before = torch.get_num_threads()
            self.renders += 1
            # The thread pool of the parent does not survive a fork: waiting for it would never end.
            now = 1 if self.forked else self.before if wish == "auto" else int(wish)
            if now != torch.get_num_threads():
                torch.set_num_threads(now)
            start_team()

    def leave(self) -> None:
        with self.lock:
            self.renders -= 1
            # Of renders that overlap, the last one puts back what the first one found.
            if self.renders == 0 and torch.get_num_threads() != self.before and not self.forked:
                torch.set_num_threads(self.before)


#: Of the process, as the thread count is.
_wish = _Wish(forked=False)


def _after_fork() -> None:
    global _wish
    _wish = _Wish(forked=True)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@contextmanager
def limited_threads(wish: int | str) -> Iterator[None]:
    """Let torch use ``wish`` threads for a while."""
    here = _wish
    here.enter(wish)
    try:
        yield
    finally:
        if here is _wish:  # else this is the child of a fork, where another thread may have held the lock
            here.leave()
