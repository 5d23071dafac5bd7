"""Handle Ctrl-C and SIGTERM: the first signal ends a render after its chunk, the second ends the process at once."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

__all__ = ["Interrupt", "Interrupted", "interruption"]


class Interrupted(BaseException):
    """A signal that arrived before there is a picture to keep. Not an `Exception`, so that no handler swallows it."""

    def __init__(self, signum: int) -> None:
        self.signum = signum
        super().__init__(signum)

    @property
    def exit_code(self) -> int:
        """Exit code by the shell's convention: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signum


def interruption(error: BaseException) -> Interrupted | None:
    """Return the `Interrupted` that caused an error, or None.

    Python wraps an exception that is raised inside some of its own calls: 3.11 turns one in ``__set_name__`` (which importing
    a module with dataclasses calls) into a ``RuntimeError``.
    """
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, Interrupted):
            return seen
        seen = seen.__cause__ or seen.__context__
    return None


class Interrupt:
    """Context manager that catches SIGINT and SIGTERM.

    Attributes:
        signum: the signal that arrived, or None.
        deferred: while True the first signal only sets ``signum``; while False it raises `Interrupted`.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self.deferred = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        """Install the signal handlers, if this is the main thread (Python allows them nowhere else)."""
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._previous[signum] = signal.signal(signum, self._arrived)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the previous handlers."""
        for signum, handler in self._previous.items():
            signal.signal(signum, handler)
        self._previous.clear()

    def _arrived(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is not None:
            os._exit(128 + signum)
        self.signum = signum
        if not self.deferred:
            raise Interrupted(signum)

    def check(self) -> None:
        """Raise `Interrupted` if a signal has arrived."""
        if self.signum is not None:
            raise Interrupted(self.signum)
