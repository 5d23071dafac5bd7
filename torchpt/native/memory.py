"""What the process holds of memory, and what it says where there is no more."""

from __future__ import annotations

import ctypes
import errno
import gc
import mmap
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import torch

from torchpt.errors import RenderError, TorchptError

__all__ = ["MARGIN", "Meter", "after_import", "let_go", "mb", "needing", "ran_out", "room_for", "size_of"]

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
#: Bytes of addresses that libraries may ask for while they make code: some of them end the process where there are none.
MARGIN = 96 << 20


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
def needing(what: str) -> Iterator[None]:
    """Context that says in a line what it was for that there is not enough memory.

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
    raise RenderError(f"not enough memory for {what}, with {mb(max(held, 0))} held already")


def let_go() -> None:
    """Give back what nobody holds any more: cycles, what allocators keep for later."""
    gc.collect()
    if torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> ctypes._NamedFuncPointer | None:
    """Glibc's ``malloc_trim``; None elsewhere."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):
        return None


def room_for(size: int) -> bool:
    """Whether the system would let the process have so many bytes of addresses more."""
    try:
        mmap.mmap(-1, size).close()
    except (OSError, MemoryError, ValueError):
        return False
    return True


class Meter:
    """What is held of a device's memory, in bytes: of the process on a CPU (pages that are really there), of tensors on CUDA.

    Args:
        device: which.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def now(self) -> int:
        """Held at the moment."""
        if self.device.type == "cuda":
            return torch.cuda.memory_allocated(self.device)
        return _status("VmRSS:")

    def peak(self) -> int:
        """The most that was ever held."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device)
        return _status("VmHWM:")

    def base(self) -> int:
        """What is no part of any render."""
        return 0 if self.device.type == "cuda" else after_import()


@cache
def after_import() -> int:
    """Bytes that the process held when all modules were there; the first call is that moment."""
    import llvmlite.binding
    import numba

    assert numba and llvmlite
    return _status("VmRSS:")


def _status(key: str) -> int:
    """A line of what Linux tells of the process; elsewhere the peak, which is all that is known; 0 where nothing is."""
    try:
        with open("/proc/self/status", "rb") as file:
            for line in file:
                if line.startswith(key.encode()):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def mb(size: float) -> str:
    """A number of bytes as one would write it, rounded up: ``37MB``."""
    return f"{-int(-size // 1_000_000)}MB"


def size_of(value: object) -> int:
    """Bytes of the tensors in nested records, each storage once."""
    return _size(value, set())


def _size(value: object, seen: set[int]) -> int:
    if isinstance(value, torch.Tensor):
        storage = value.untyped_storage()
        if storage.data_ptr() in seen:
            return 0
        seen.add(storage.data_ptr())
        return storage.nbytes()
    if isinstance(value, dict):
        return sum(_size(item, seen) for item in value.values())
    if isinstance(value, list | tuple):
        return sum(_size(item, seen) for item in value)
    return 0
