"""Standard output and standard error, whatever stands at their other end.

A reader that has enough (``| head``) is no error. A full disk under ``> FILE`` is one, told in a line. What stderr says is for
people and never worth a picture: where it cannot be written it is left unsaid.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from torchpt.core.errors import OutputError

__all__ = ["flushed_stdout", "open_streams"]


def open_streams() -> None:
    """Make all three streams usable, for a process that is the command's own.

    A closed one would give its number to the next file that is opened, and what is meant for a terminal would end up there.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name, number in (("stdin", 0), ("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    sys.stderr = _Lenient(sys.stderr)


class _Lenient:
    """A stream to which nothing is written where that is not possible."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """As a stream's."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """As a stream's."""
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def flushed_stdout() -> Iterator[None]:
    """Context in which a command prints to standard output what it is asked for.

    Raises:
        OutputError: it cannot be written, though somebody would read it.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _mute()
    except OSError as error:
        _mute()
        raise OutputError("standard output", f"cannot be written ({error.strerror or error})") from None


def _mute() -> None:
    """Send to nowhere what is still to be written, or Python complains of it when it ends."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
