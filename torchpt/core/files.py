"""Files: paths from users, safe reading of files that a scene names, and configs (YAML) that ship with torchpt.

A scene may name anything: ``/dev/zero`` is endless, and opening a pipe blocks. So only regular files are read.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

from torchpt.core.errors import SceneError

__all__ = [
    "MAX_BYTES",
    "UnreadableFile",
    "as_path",
    "check_regular",
    "configs",
    "is_regular",
    "read_regular",
    "written_path",
]

#: Size limit of mesh and picture files in bytes.
MAX_BYTES = 4 * 2**30

_PACKAGE = Path(__file__).resolve().parent.parent
_READ_BYTES = 2**20  # bytes of a read once a file turns out longer than its size


class UnreadableFile(OSError):
    """A path that is not read although it exists; ``strerror`` says why and lacks its subject: "is a folder"."""


def as_path(path: Any) -> Path:
    """Return a user's path as a ``Path``.

    Raises:
        SceneError: neither a string nor a path of strings.
    """
    text = os.fspath(path) if isinstance(path, str | os.PathLike) else None
    if not isinstance(text, str):  # a PathLike may return bytes
        raise SceneError("path", path, "a file's path, as text or a pathlib.Path")
    return Path(text)


def written_path(path: str, key: str) -> Path:
    """Return the path of a file to write, with a home folder in place of ``~``.

    Raises:
        SceneError: a user of whom no home folder is known; ``key`` is that of the path.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise SceneError(key, path, "a path, without ~ or with one of a user who has a home folder here") from None


def is_regular(path: str | os.PathLike[str]) -> bool:
    """Return True for an existing regular file (or a link to one): not a folder, device, pipe or socket."""
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):  # a name too long, or one with a NUL
        return False


def check_regular(path: str | os.PathLike[str], max_bytes: int | None = None) -> int:
    """Return the size of a regular file in bytes.

    Args:
        path: path of the file.
        max_bytes: size limit; None: no limit.

    Raises:
        UnreadableFile: a folder, device, pipe or socket, or a file of more than ``max_bytes``.
        OSError: no such file.
    """
    try:
        status = os.stat(path)
    except ValueError:  # a name with a NUL
        raise UnreadableFile(errno.EINVAL, "has a name that no file can have") from None
    if stat.S_ISDIR(status.st_mode):
        raise UnreadableFile(errno.EISDIR, "is a folder")
    if not stat.S_ISREG(status.st_mode):
        raise UnreadableFile(errno.EINVAL, "is a device, a pipe or a socket")
    if max_bytes is not None and status.st_size > max_bytes:
        raise UnreadableFile(errno.EFBIG, f"has {status.st_size} bytes; at most {max_bytes} are read")
    return status.st_size


def read_regular(path: str | os.PathLike[str], max_bytes: int = MAX_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: as :func:`check_regular`, or it cannot be read.
    """
    size = check_regular(path, max_bytes)
    with Path(path).open("rb", buffering=0) as file:
        reads = [file.read(size + 1)]
        total = len(reads[0])
        # Read on to the end of the file: it may have grown, or have had no known size (as under /proc).
        while reads[-1]:
            if total > max_bytes:
                raise UnreadableFile(errno.EFBIG, f"has more than {max_bytes} bytes; at most so many are read")
            reads.append(file.read(min(_READ_BYTES, max_bytes + 1 - total)))
            total += len(reads[-1])
    return reads[0] if total == len(reads[0]) else b"".join(reads)  # the usual case without a copy


def configs() -> Path:
    """Return the folder of the configs that ship (``scene/``, ...): ``share/`` of an installed wheel, or the checkout's."""
    installed = _PACKAGE / "share" / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"
