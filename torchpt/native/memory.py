"""What the process holds of memory, and what the system would give it."""

from __future__ import annotations

import ctypes
import gc
import mmap
import sys
from functools import cache
from pathlib import Path

import torch

__all__ = ["MARGIN", "Meter", "after_import", "free_memory", "let_go", "mb", "room_for"]

#: Bytes of addresses that libraries may ask for while they make code: some of them end the process where there are none.
MARGIN = 96 << 20

#: Where Linux tells what is free, and what control groups may take.
_MEMINFO = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")


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
    """Bytes that the process held when modules were there; the first call is that moment."""
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


def free_memory() -> int | None:
    """Bytes that a process could have of the machine's memory, and of its container's; None where nobody tells."""
    found = [size for size in (_of_machine(), _of_group()) if size is not None]
    return min(found, default=None)


def _of_machine() -> int | None:
    try:
        lines = _MEMINFO.read_text().splitlines()
        return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)
    except (OSError, ValueError, IndexError):
        return None


def _of_group() -> int | None:
    """What the limit of a control group (version 2) leaves, what it keeps of files not counted as taken."""
    try:
        limit = int((_GROUP / "memory.max").read_text())
        taken = int((_GROUP / "memory.current").read_text())
        facts = dict(line.split() for line in (_GROUP / "memory.stat").read_text().splitlines())
        return limit - taken + int(facts.get("inactive_file", 0))
    except (OSError, ValueError):  # no such group, or no limit ("max")
        return None
