"""Digests of code, which ignore docstrings, comments, and path and time of the file.

They are the keys of the kernel cache, see :mod:`torchpt.native.cache`.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from torchpt.native import cache

__all__ = ["code_of_folder", "code_of_function"]

_PACKAGE = Path(__file__).parent.parent


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


# -- a whole folder


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


def _code(code: CodeType, documented: bool = False) -> tuple[Any, ...]:
    """Return the content of a code object without line numbers and file name, and without the docstring if ``documented``."""
    consts = tuple(_constant(x) for x in code.co_consts[documented:])
    places = (code.co_argcount, code.co_kwonlyargcount, code.co_posonlyargcount, code.co_flags)
    names = (code.co_name, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
    return code.co_code, consts, places, names, getattr(code, "co_exceptiontable", b"")


def _constant(value: Any) -> Any:
    if isinstance(value, CodeType):
        return _code(value)
    if isinstance(value, frozenset):  # its order depends on the process
        return "frozenset", sorted(map(repr, value))
    return type(value).__name__, repr(value)


# -- a numba function


def code_of_function(function: Callable[..., Any]) -> str:
    """Return a digest of a numba function: its code, the values of the globals it reads, and the functions that it calls.

    Raises:
        TypeError: the function reads a global of a type without a digest.
    """
    found: dict[int, tuple[int, Any]] = {}  # by id: number and object, which keeps the id in use
    return _digest(repr(_content(function, found)))


def _content(value: Any, found: dict[int, tuple[int, Any]]) -> Any:
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.generic | np.dtype):
        return type(value).__name__, repr(value)
    if isinstance(value, tuple):
        return tuple(_content(x, found) for x in value)
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()
    if hasattr(value, "py_func"):  # a function that numba compiles
        return repr(sorted(value.targetoptions.items())), _content(value.py_func, found)
    if hasattr(value, "_defn"):  # an intrinsic: its IR depends on the modules of its folder
        return value._defn.__qualname__, _folder_of(value._defn)
    if isinstance(value, FunctionType):
        if _is_ours(value.__module__):
            return _function(value, found)
        return value.__module__, value.__qualname__
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, BuiltinFunctionType | np.ufunc | type) or type(value).__module__.startswith("numba."):
        return type(value).__name__, getattr(value, "__module__", None), getattr(value, "__name__", None) or repr(value)
    raise TypeError(f"no content of {value!r}")


def _function(function: FunctionType, found: dict[int, tuple[int, Any]]) -> Any:
    known = found.get(id(function))
    if known is not None:
        return "above", known[0]
    found[id(function)] = len(found), function
    names = sorted(_names(function.__code__))
    read = {name: function.__globals__[name] for name in names if name in function.__globals__}
    for module in [x for x in read.values() if isinstance(x, ModuleType) and _is_ours(x.__name__)]:
        read |= {f"{module.__name__}.{name}": getattr(module, name) for name in names if hasattr(module, name)}
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    given = tuple(function.__defaults__ or ()), tuple(sorted((function.__kwdefaults__ or {}).items())), *cells
    code = _code(function.__code__, documented=function.__doc__ is not None)
    return code, _content(given, found), [(name, _content(value, found)) for name, value in read.items()]


def _names(code: CodeType) -> set[str]:
    inner = (_names(x) for x in code.co_consts if isinstance(x, CodeType))
    return set(code.co_names).union(*inner)


def _is_ours(module: str) -> bool:
    """Return False for modules of libraries, whose versions are part of the keys."""
    return module.split(".")[0] not in {"numba", "numpy", "torch", "llvmlite", *sys.stdlib_module_names} - {"__main__"}


def _folder_of(function: Any) -> str:
    return code_of_folder(Path(function.__code__.co_filename).parent)
