"""Digests of Python code, which ignore docstrings, comments, assertions, and path and time of the file.

The digest of the whole package enters the cache keys of compiled stages (``compiler/cache.py``): an edit of any code in the
package makes them stale, an edit of text does not.
"""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import CodeType
from typing import Any

from torchpt.native import cache

__all__ = ["code_of_folder"]

_PACKAGE = Path(__file__).parent.parent


@functools.cache
def code_of_folder(folder: Path = _PACKAGE) -> str:
    """Return a digest of the code of all modules below a folder, by default of the whole package.

    The digest of each file is kept on disk. A file is read again only if its size or time has changed.
    """
    name = cache.digest(str(folder)) + ".json"
    # by path relative to the folder: [size in bytes, time of change in nanoseconds, digest]
    on_disk: dict[str, list[Any]] = json.loads(cache.read(name) or b"{}")
    present: dict[str, list[Any]] = {}
    for path, facts in _modules(str(folder)):
        key, state = os.path.relpath(path, folder), [facts.st_size, facts.st_mtime_ns]
        entry = on_disk.get(key)
        present[key] = entry if entry is not None and entry[:2] == state else [*state, _digest_of_file(path)]
    if present != on_disk:
        cache.write(name, json.dumps(present).encode())
    return cache.digest(repr(sorted((key, digest) for key, (_, _, digest) in present.items())))


def _modules(folder: str) -> Iterator[tuple[str, os.stat_result]]:
    """Yield path and status of each Python file below a folder."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                yield entry.path, entry.stat()
            elif entry.is_dir() and entry.name != "__pycache__":
                yield from _modules(entry.path)


def _digest_of_file(path: str) -> str:
    # optimize=2 removes docstrings and asserts
    return cache.digest(repr(_content(compile(Path(path).read_bytes(), "", "exec", dont_inherit=True, optimize=2))))


def _content(code: CodeType) -> tuple[Any, ...]:
    """Return the content of a code object without line numbers and file name."""
    consts = tuple(_constant(x) for x in code.co_consts)
    signature = (code.co_argcount, code.co_kwonlyargcount, code.co_posonlyargcount, code.co_flags)
    names = (code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return code.co_code, consts, signature, names, getattr(code, "co_exceptiontable", b"")


def _constant(value: Any) -> Any:
    """Return the content of a constant; its type as well, since ``repr`` alone may be equal."""
    if isinstance(value, CodeType):  # a function or class within the code
        return _content(value)
    if isinstance(value, frozenset):  # the order of its elements depends on the process
        return "frozenset", sorted(map(repr, value))
    return type(value).__name__, repr(value)
