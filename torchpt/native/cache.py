"""Keep kernels on disk: a folder of entries, never larger than it may be.

An entry is found by the content that it was made of, so that all checkouts and processes of a user share the folder. Entries
are native code, so the folder is this user's alone (mode 0700, owner checked) and each carries a checksum. Where there can be
no such folder, nothing is kept.
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

#: Bytes of all entries from which on those go that were not used for the longest time, until half of that is left.
MOST = 1 << 29
#: Seconds after which a use is noted again, and what a killed process left of an entry is nobody's.
DAY = 86_400.0
#: Begins the names of entries that are being written.
_UNFINISHED = "unfinished-"
#: What may be removed: the folder may hold files of others.
_OURS = re.compile(rf"[0-9a-f]{{40}}\.(o|json|nbc)|{_UNFINISHED}.*")


def cache_folder() -> Path | None:
    """Where kernels are kept: ``$TORCHPT_CACHE``, else the user's cache folder; None where that cannot be trusted."""
    given = os.environ.get("TORCHPT_CACHE")
    if given == "":
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # as its specification says
        base = os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(given).absolute() if given else Path(base) / "torchpt" / "kernels"
    if not folder.is_absolute():  # no home
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = [folder.stat(), folder.lstat()]  # a link must be this user's as well
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
    """An entry of the cache; None where there is none, or a damaged or a doubtful one, which is made again."""
    folder = _folder()
    if folder is None:
        return None
    try:
        # A pipe in the place of an entry would be waited for.
        flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)
        handle = os.open(folder / name, os.O_RDONLY | flags)
        with os.fdopen(handle, "rb") as file:
            facts = os.fstat(handle)
            if not stat.S_ISREG(facts.st_mode):
                return None
            # Whoever may rename the folder could have put another in its place since it was looked at.
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
    """Put an entry in its place at once or not at all; a full disk is no reason to stop."""
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
    """Remove what was not used for the longest time, where the folder is too large; once a process, which has code to make."""
    found, now = [], time.time()
    with suppress(OSError), os.scandir(folder) as files:
        for file in files:
            with suppress(OSError):  # another process is at it
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
