"""Create a temporary folder for the files of Hydra's sweeper, and delete the folders of sweeps that were killed."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["sweep_folder"]

#: Name of the folder. It holds the process id, by which a later sweep recognises the folders of dead processes.
_NAME = re.compile(r"torchpt-sweep-(\d+)-\w+")


@contextmanager
def sweep_folder() -> Iterator[str]:
    """Yield a folder that is deleted at the end of the context; first delete the folders of dead processes."""
    _delete_dead_folders()
    with tempfile.TemporaryDirectory(prefix=f"torchpt-sweep-{os.getpid()}-", ignore_cleanup_errors=True) as folder:
        yield folder


def _delete_dead_folders() -> None:
    """Delete this user's folders of sweeps whose processes have ended."""
    if os.name != "posix":  # elsewhere os.kill with signal 0 would end the process
        return
    for folder in Path(tempfile.gettempdir()).glob("torchpt-sweep-*"):
        match = _NAME.fullmatch(folder.name)
        try:
            is_dead = match is not None and folder.lstat().st_uid == os.getuid() and not _is_alive(int(match[1]))
        except OSError:  # another process deleted it first
            continue
        if is_dead and not folder.is_symlink():
            shutil.rmtree(folder, ignore_errors=True)


def _is_alive(process: int) -> bool:
    """Return True if a process of this id exists, whoever owns it."""
    try:
        os.kill(process, 0)  # sends no signal, but fails if there is no such process
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
