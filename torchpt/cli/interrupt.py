"""Ctrl-C and SIGTERM: a render ends with its chunk and keeps what it has; a second signal ends the process at once."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any

__all__ = ["Interrupt", "Interrupted", "interruption"]


class Interrupted(BaseException):
    """The first signal, where there is no picture to keep yet. Not an `Exception`: nothing handles it on the way."""

    def __init__(self, signum: int) -> None:
        self.signum = signum
        super().__init__(signum)

    @property
    def exit_code(self) -> int:
        """130 for Ctrl-C, 143 for SIGTERM: the shell's convention."""
        return 128 + self.signum


def interruption(error: BaseException) -> Interrupted | None:
    """Return the signal that an error comes from; None where it comes from none.

    Where a signal arrives while Python itself calls a method, it is wrapped in an error of Python's own: in 3.11 one in
    ``__set_name__`` becomes a ``RuntimeError``, as where a module with dataclasses is imported.
    """
    seen: BaseException | None = error
    while seen is not None:
        if isinstance(seen, Interrupted):
            return seen
        seen = seen.__cause__ or seen.__context__
    return None


class Interrupt:
    """Context in which SIGINT and SIGTERM ask instead of kill.

    Attributes:
        signum: the signal that came, or None.
        deferred: while True the first signal only sets ``signum``; while False it raises `Interrupted`.
    """

    def __init__(self) -> None:
        self.signum: int | None = None
        self.deferred = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Interrupt:
        """Install the handlers, where Python allows it: in the main thread."""
        if threading.current_thread() is threading.main_thread():
            for signum in (signal.SIGINT, signal.SIGTERM):
                self._previous[signum] = signal.signal(signum, self._arrived)
        return self

    def __exit__(self, *_: object) -> None:
        """Restore the handlers that were there."""
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
        """Raise `Interrupted` where a signal has come."""
        if self.signum is not None:
            raise Interrupted(self.signum)
