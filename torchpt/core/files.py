"""Files: those that others name, regular ones only and no larger than is said, and those that ship with torchpt.

A scene may name anything: ``/dev/zero`` has no end, and a pipe is opened only once somebody writes to it.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError

__all__ = ["MAX_BYTES", "UnreadableFile", "as_path", "check_regular", "configs", "is_regular", "read_regular"]

#: Bytes of the largest mesh or picture file that is read.
MAX_BYTES = 4 * 2**30

_PACKAGE = Path(__file__).resolve().parent.parent
_PIECE = 2**20  # bytes read at a time of a file that is longer than it said


class UnreadableFile(OSError):
    """Something that is there and is not read; ``strerror`` says why, as what "it" is or has."""


def as_path(path: Any) -> Path:
    """A path as users give it.

    Raises:
        SceneError: something else.
    """
    found = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(found, str):  # bytes neither
        raise SceneError("path", path, "a file's path, as text or a pathlib.Path")
    return Path(found)


def is_regular(path: str | os.PathLike[str]) -> bool:
    """Whether it is there and a regular file (or a link to one): no folder, device, pipe or socket."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):  # a name too long, or one with a NUL
        return False


def check_regular(path: str | os.PathLike[str], most: int | None = None) -> int:
    """The size in bytes of a regular file.

    Args:
        path: of the file.
        most: bytes that it may have; None: any number.

    Raises:
        UnreadableFile: a folder, device, pipe or socket, or a file of more than ``most`` bytes.
        OSError: no such file.
    """
    try:
        facts = os.stat(path)
    except ValueError:
        raise UnreadableFile(errno.EINVAL, "has a name that no file can have") from None
    if stat.S_ISDIR(facts.st_mode):
        raise UnreadableFile(errno.EISDIR, "is a folder")
    if not stat.S_ISREG(facts.st_mode):
        raise UnreadableFile(errno.EINVAL, "is a device, a pipe or a socket")
    if most is not None and facts.st_size > most:
        raise UnreadableFile(errno.EFBIG, f"has {facts.st_size} bytes; at most {most} are read")
    return facts.st_size


def read_regular(path: str | os.PathLike[str], most: int = MAX_BYTES) -> bytes:
    """The bytes of a regular file.

    Raises:
        OSError: as :func:`check_regular`, or it cannot be read.
    """
    size = check_regular(path, most)
    with Path(path).open("rb", buffering=0) as file:
        parts = [file.read(size + 1)]
        total = len(parts[0])
        while parts[-1]:  # it has grown, or is one of those that do not know their size
            if total > most:
                raise UnreadableFile(errno.EFBIG, f"has more than {most} bytes; at most so many are read")
            parts.append(file.read(min(_PIECE, most + 1 - total)))
            total += len(parts[-1])
    return parts[0] if total == len(parts[0]) else b"".join(parts)  # not twice in memory


def configs() -> Path:
    """Return the folder of the config groups that ship (``scene/``, ...), in an installed wheel or in a checkout."""
    installed = _PACKAGE / "share" / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"
