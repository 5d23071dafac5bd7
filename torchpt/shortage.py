"""Errors that say that memory ran out, and the line that users read instead of them."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from torchpt.errors import RenderError, TorchptError
from torchpt.native.memory import Meter, after_import, mb

__all__ = ["needing", "ran_out"]

#: What errors of exhausted memory say where their type does not.
_SAID = (
    "can't allocate memory",
    "not enough memory",
    "out of memory",
    "bad_alloc",
    "Cannot allocate memory",
    "can't start new thread",
    "failed to map segment",
)


def ran_out(error: BaseException) -> bool:
    """Whether an error, or what it came of, says that there is no more memory, on whatever device."""
    if isinstance(error, TorchptError):  # somebody said so already
        return False
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        if isinstance(cause, MemoryError | torch.cuda.OutOfMemoryError):
            return True
        if isinstance(cause, OSError) and cause.errno == errno.ENOMEM:
            return True
        if isinstance(cause, RuntimeError | ImportError | OSError) and any(text in str(cause) for text in _SAID):
            return True
        cause = cause.__cause__ or cause.__context__
    return False


@contextmanager
def needing(what: str | Callable[[], str]) -> Iterator[None]:
    """Context that says in a line what it was for that there is not enough memory: a text, or what makes one.

    Raises:
        RenderError: there is not.
    """
    try:
        yield
    except Exception as error:
        if not ran_out(error):
            raise
    else:
        return
    held = Meter(torch.device("cpu")).now() - after_import()
    told = what if isinstance(what, str) else what()
    raise RenderError(f"not enough memory for {told}, with {mb(max(held, 0))} held already")
