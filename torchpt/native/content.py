"""Digests of code, which ignore docstrings, comments, and path and time of the file.

They are the keys of the kernel cache, see :mod:`torchpt.native.cache`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from types import CodeType
from typing import Any

from torchpt.native import cache

__all__ = ["code_of_folder"]

_PACKAGE = Path(__file__).parent.parent


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@functools.cache
def code_of_folder(folder: Path = _PACKAGE) -> str:
    """Return a digest of the code of all modules below a folder, by default of the whole package.

    A file is read again only if its size or time has changed: digests are cached. ``assert`` statements are ignored.
    """
    name = _digest(str(folder))[:40] + ".json"
    kept: dict[str, list[Any]] = json.loads(cache.read(name) or b"{}")
    found: dict[str, list[Any]] = {}
    for path, facts in _modules(str(folder)):
        place, state = os.path.relpath(path, folder), [facts.st_size, facts.st_mtime_ns]
        known = kept.get(place)
        found[place] = known if known is not None and known[:2] == state else [*state, _code_of_file(path)]
    if found != kept:
        cache.write(name, json.dumps(found).encode())
    return _digest(repr(sorted((place, known[2]) for place, known in found.items())))


def _modules(folder: str) -> Iterator[tuple[str, os.stat_result]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith(".py"):
                yield entry.path, entry.stat()
            elif entry.is_dir() and entry.name != "__pycache__":
                yield from _modules(entry.path)


def _code_of_file(path: str) -> str:
    # optimize=2 removes docstrings and asserts
    return _digest(repr(_code(compile(Path(path).read_bytes(), "", "exec", dont_inherit=True, optimize=2))))


def _code(code: CodeType) -> tuple[Any, ...]:
    """Return the content of a code object without line numbers and file name."""
    consts = tuple(_constant(x) for x in code.co_consts)
    places = (code.co_argcount, code.co_kwonlyargcount, code.co_posonlyargcount, code.co_flags)
    names = (code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return code.co_code, consts, places, names, getattr(code, "co_exceptiontable", b"")


def _constant(value: Any) -> Any:
    if isinstance(value, CodeType):
        return _code(value)
    if isinstance(value, frozenset):  # its order depends on the process
        return "frozenset", sorted(map(repr, value))
    return type(value).__name__, repr(value)
