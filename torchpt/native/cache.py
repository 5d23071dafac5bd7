"""The cache of kernels on disk: a folder of limited size.

An entry is a file. Its name is a digest of the code that it was compiled from, so all checkouts and processes of a user share
the folder. Its suffix says what it holds: ``.o`` object code, ``.quick`` quick code and its IR, ``.ptx`` code for a GPU,
``.json`` digests of source files (:mod:`torchpt.native.content`) or checks of a GPU; ``.unasked`` says that a program was
begun and not needed. Entries are executed, so only the user may access the folder (mode 0700, owner checked), and each entry
has a checksum. Without such a folder nothing is cached.
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

__all__ = ["cache_folder", "digest", "read", "write"]

#: Largest size of the folder in bytes (512 MiB). Beyond it the least recently used entries are removed until half is left.
MOST = 1 << 29
#: Seconds after which the time of use of an entry is updated, and an unfinished entry counts as abandoned.
DAY = 86_400.0
#: Hexadecimal digits of a SHA-256 that name an entry.
_KEY_DIGITS = 40
#: Bytes of the checksum before the content of an entry: a SHA-256.
_CHECKSUM_BYTES = 32
#: Prefix of the names of entries that are being written.
_UNFINISHED = "unfinished-"
#: Names of files that this module may remove, since the folder may hold other files, such as the results of
#: device checks, which are few and stay. Earlier versions wrote ``.nbc``.
_OURS = re.compile(rf"[0-9a-f]{{{_KEY_DIGITS}}}\.(o|json|nbc|ptx|quick|unasked)|{_UNFINISHED}.*")


def digest(*texts: str) -> str:
    """Return the digest of some texts that names an entry."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()[:_KEY_DIGITS]


def cache_folder() -> Path | None:
    """Return the cache folder: ``$TORCHPT_CACHE``, else one below the user's cache folder, made if it is missing.

    Returns None, for no cache, if the variable is empty, or if the folder cannot be made or is not private.
    """
    given = os.environ.get("TORCHPT_CACHE")
    if given == "":
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # relative paths are ignored, by the XDG specification
        base = os.path.join(os.path.expanduser("~"), ".cache")
    folder = Path(given).absolute() if given else Path(base) / "torchpt" / "kernels"
    if not folder.is_absolute():  # the user has no home folder, so "~" was left in the path
        return None
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # if the folder is a symbolic link: of its target, and of the link, which must belong to the user, too
        facts = [folder.stat(), folder.lstat()]
    except OSError:
        return None
    if not hasattr(os, "getuid"):  # Windows, whose files have no owners and modes to check
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
        # A link is not followed. Non-blocking, as a pipe that somebody has put in place of the entry would block.
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
    checksum, code = content[:_CHECKSUM_BYTES], content[_CHECKSUM_BYTES:]
    return code if _checksum(name, code) == checksum else None


def _checksum(name: str, code: bytes) -> bytes:
    """Return the checksum of an entry; its name is part of it, so that a renamed entry counts as damaged."""
    return hashlib.sha256(name.encode() + code).digest()


def write(entry: str, code: bytes) -> None:
    """Write an entry atomically; errors such as a full disk are ignored."""
    folder = _folder()
    if folder is None:
        return
    _remove_old_entries(folder)
    path, unfinished = folder / entry, None
    try:
        handle, unfinished = tempfile.mkstemp(dir=path.parent, prefix=_UNFINISHED)
        with os.fdopen(handle, "wb") as file:
            file.write(_checksum(entry, code) + code)
        os.replace(unfinished, path)
    except OSError:
        if unfinished is not None:
            try:
                os.unlink(unfinished)
            except OSError:
                print(f"torchpt: {unfinished} could not be removed", file=sys.stderr)


@cache  # so that a process does it once, before its first write
def _remove_old_entries(folder: Path) -> None:
    """Remove abandoned entries, and the least recently used ones if the folder is too large."""
    found, now = [], time.time()  # (time of use, size, path)
    with suppress(OSError), os.scandir(folder) as files:
        for file in files:
            with suppress(OSError):  # another process may remove it at the same time
                facts = file.stat(follow_symlinks=False)
                if stat.S_ISREG(facts.st_mode) and _OURS.fullmatch(file.name):
                    abandoned = file.name.startswith(_UNFINISHED) and now - facts.st_mtime > DAY
                    found.append((0.0 if abandoned else facts.st_mtime, facts.st_size, file.path))
    total = sum(size for _, size, _ in found)
    limit = MOST if total <= MOST else MOST // 2
    for used, size, path in sorted(found):  # abandoned entries first: their time is 0
        if total <= limit and used > 0.0:
            break
        with suppress(OSError):
            os.unlink(path)
        total -= size
