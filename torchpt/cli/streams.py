"""Write to standard output and standard error, also if they are closed, full or no longer read.

A closed pipe (``| head``) is not an error. A full disk under ``> FILE`` is one, reported in one line. Messages on stderr that
cannot be written are dropped: they must not cost a picture.
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
    """Open closed standard streams, and ignore write errors on stderr. Only for a process that runs nothing but the command.

    The next file that is opened would get the number of a closed stream, and messages for a terminal would go into that file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name, number in (("stdin", 0), ("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", closefd=False))
    sys.stderr = _ErrorIgnoringStream(sys.stderr)


class _ErrorIgnoringStream:
    """A text stream that ignores write errors."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write `text`; see :meth:`io.TextIOBase.write`."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream; see :meth:`io.IOBase.flush`."""
        with suppress(OSError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def flushed_stdout() -> Iterator[None]:
    """Flush standard output at the end of the context, and handle its write errors.

    Raises:
        OutputError: standard output cannot be written, for another reason than a closed pipe.
    """
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        _redirect_stdout_to_null()
    except OSError as error:
        _redirect_stdout_to_null()
        raise OutputError("standard output", f"cannot be written ({error.strerror or error})") from None


def _redirect_stdout_to_null() -> None:
    """Redirect standard output to the null device: Python would report the failed flush at exit."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
