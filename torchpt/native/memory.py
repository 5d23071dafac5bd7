"""How much memory there is, as far as the system tells."""

from __future__ import annotations

from pathlib import Path

__all__ = ["free_memory"]

_MEMINFO = Path("/proc/meminfo")
_GROUP = Path("/sys/fs/cgroup")


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
