"""The cache of kernels on disk: a folder of limited size.

The name of an entry is a digest of the code that it was compiled from, so all checkouts and processes of a user share the
folder. Entries are native code, so only the user may access the folder (mode 0700, owner checked), and each entry has a
checksum. Without such a folder nothing is cached.
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import sys
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

__all__ = ["cache_folder", "read", "write"]

#: Largest size of the folder in bytes; beyond it the least recently used entries are removed until half of it is left.
MOST = 1 << 29
#: Seconds after which the time of use of an entry is updated, and an unfinished entry counts as abandoned.
DAY = 86_400.0
#: Prefix of the names of entries that are being written.
_UNFINISHED = "unfinished-"
#: Files that may be removed: the folder may hold other files. Entries ``.nbc`` are of earlier versions.
_OURS = re.compile(rf"[0-9a-f]{{40}}\.(o|json|nbc|ptx)|{_UNFINISHED}.*")


def cache_folder() -> Path | None:
    """Return the cache folder: ``$TORCHPT_CACHE``, else below the user's cache folder; None if it is missing or not private."""
    given = os.environ.get("TORCHPT_CACHE")
    if given == "":
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # relative paths are ignored, by the XDG specification
        base = os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(given).absolute() if given else Path(base) / "torchpt" / "kernels"
    if not folder.is_absolute():  # no home
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = [folder.stat(), folder.lstat()]  # a link must belong to the user, too
    except OSError:
        return None
    if not hasattr(os, "getuid"):  # no owners and modes to check
        return folder
    if any(fact.st_uid != os.getuid() for fact in facts) or stat.S_IMODE(facts[0].st_mode) & 0o077:
        return None
    return folder


@cache
def _folder() -> Path | None:
    return cache_folder()


def read(name: str) -> bytes | None:
    """Read an entry; None if it is missing, damaged or not owned by the user."""
    folder = _folder()
    if folder is None:
        return None
    try:
        # Non-blocking, as a pipe in place of the entry would block.
        flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
        handle = os.open(folder / name, os.O_RDONLY | flags)
        with os.fdopen(handle, "rb") as file:
            facts = os.fstat(handle)
            if not stat.S_ISREG(facts.st_mode):
                return None
            # The folder may have been replaced since it was checked.
            if hasattr(os, "getuid") and (facts.st_uid != os.getuid() or facts.st_mode & 0o022):
                return None
            content = file.read()
            if time.time() - facts.st_mtime > DAY:
                with suppress(OSError):
                    os.utime(folder / name)
    except OSError:
        return None
    check, code = content[:32], content[32:]
    return code if _check(name, code) == check else None


def _check(name: str, code: bytes) -> bytes:
    return hashlib.sha256(name.encode() + code).digest()


def write(entry: str, code: bytes) -> None:
    """Write an entry atomically; errors such as a full disk are ignored."""
    folder = _folder()
    if folder is None:
        return
    _tidied(folder)
    path, name = folder / entry, None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=_UNFINISHED)
        with os.fdopen(handle, "wb") as file:
            file.write(_check(entry, code) + code)
        os.replace(name, path)
    except OSError:
        if name is not None:
            try:
                os.unlink(name)
            except OSError:
                print(f"torchpt: {name} could not be removed", file=sys.stderr)


@cache
def _tidied(folder: Path) -> None:
    """Remove the least recently used entries if the folder is too large; once a process, before its first write."""
    found, now = [], time.time()
    with suppress(OSError), os.scandir(folder) as files:
        for file in files:
            with suppress(OSError):  # another process may remove it at the same time
                facts = file.stat(follow_symlinks=False)
                if stat.S_ISREG(facts.st_mode) and _OURS.fullmatch(file.name):
                    left = file.name.startswith(_UNFINISHED) and now - facts.st_mtime > DAY
                    found.append((0.0 if left else facts.st_mtime, facts.st_size, file.path))
    held = sum(size for _, size, _ in found)
    most = MOST if held <= MOST else MOST // 2
    for used, size, path in sorted(found):
        if held <= most and used > 0.0:
            break
        with suppress(OSError):
            os.unlink(path)
        held -= size
