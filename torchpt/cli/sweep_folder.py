"""Where Hydra's sweeper leaves its notes, not beside the pictures; and away with those of sweeps that were killed."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["sweep_folder"]

#: Name of such a folder: whose it is, so that the next sweep knows which are nobody's any more.
_NAME = re.compile(r"torchpt-sweep-(\d+)-\w+")


@contextmanager
def sweep_folder() -> Iterator[str]:
    """Context with a folder that goes when it ends; folders that killed sweeps left behind go first."""
    _clear()
    with tempfile.TemporaryDirectory(prefix=f"torchpt-sweep-{os.getpid()}-", ignore_cleanup_errors=True) as folder:
        yield folder


def _clear() -> None:
    if os.name != "posix":  # elsewhere nobody can be asked whether a process lives without harm to it
        return
    for folder in Path(tempfile.gettempdir()).glob("torchpt-sweep-*"):
        match = _NAME.fullmatch(folder.name)
        try:
            gone = match is not None and folder.lstat().st_uid == os.getuid() and not _lives(int(match[1]))
        except OSError:  # somebody else was quicker
            continue
        if gone and not folder.is_symlink():
            shutil.rmtree(folder, ignore_errors=True)


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
