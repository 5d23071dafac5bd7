"""Nested records: dataclasses, tuples, lists and mappings that hold tensors, and whatever stands beside these.

A record's *leaves* are its tensors, in the order of its fields. Modules and other objects of a user's own are one thing
whole: no tensor of theirs is a leaf. :func:`fingerprint` alone looks into them, as it leaves nothing out.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import struct
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

__all__ = ["NOT_FINGERPRINTED", "fingerprint", "leaves", "map_leaves", "named_leaves", "rebuild", "signature"]

T = TypeVar("T")

#: ``field(metadata=NOT_FINGERPRINTED)``: of a dataclass's field that no picture depends on, such as the file that it was read from.
NOT_FINGERPRINTED = {"fingerprint": False}

_TENSOR, _MAPPING, _SEQUENCE, _STATIC = range(4)
#: By class how its instances are walked: one of the above, or the names of a dataclass's fields.
_known: dict[type, Any] = {}


def _form(kind: type) -> Any:
    """Return how instances of a class are walked."""
    if issubclass(kind, Tensor):
        form: Any = _TENSOR
    elif issubclass(kind, dict):
        form = _MAPPING
    elif issubclass(kind, tuple | list):
        form = _SEQUENCE
    elif is_dataclass(kind) and not issubclass(kind, torch.nn.Module):
        form = tuple(field.name for field in fields(kind))
    else:
        form = _STATIC
    _known[kind] = form
    return form


def leaves(record: Any) -> list[Tensor]:
    """Return the tensors of a record, in order; one that stands in two places twice."""
    found: list[Tensor] = []
    _gather(record, found)
    return found


def _gather(record: Any, found: list[Tensor]) -> None:
    kind = type(record)
    form = _known.get(kind)
    if form is None:
        form = _form(kind)
    if form is _STATIC:
        return
    if form is _TENSOR:
        found.append(record)
    elif form is _SEQUENCE:
        for value in record:
            _gather(value, found)
    elif form is _MAPPING:
        for value in record.values():
            _gather(value, found)
    else:
        for name in form:
            _gather(getattr(record, name), found)


def named_leaves(record: Any, path: str) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of a record with their dotted paths, which begin with ``path``; in the order of :func:`leaves`."""
    kind = type(record)
    form = _known.get(kind)
    if form is None:
        form = _form(kind)
    if form is _TENSOR:
        yield path, record
    elif form is _SEQUENCE:
        for number, value in enumerate(record):
            yield from named_leaves(value, f"{path}.{number}")
    elif form is _MAPPING:
        for name, value in record.items():
            yield from named_leaves(value, f"{path}.{name}")
    elif form is not _STATIC:
        for name in form:
            yield from named_leaves(getattr(record, name), f"{path}.{name}")


def map_leaves(function: Callable[..., Any], record: T, *others: T) -> T:
    """Return a record with other tensors: ``function`` of each one, and of those in the same places of ``others``.

    What holds none that changed stays itself.
    """
    made, rest = cast("Any", record), cast("Sequence[Any]", others)
    kind: Any = type(made)
    form = _known.get(kind)
    if form is None:
        form = _form(kind)
    if form is _TENSOR:
        return function(made, *rest)
    if form is _STATIC:
        return record
    if form is _SEQUENCE:
        parts = [map_leaves(function, *each) for each in zip(made, *rest, strict=True)]
        if all(new is old for new, old in zip(parts, made, strict=True)):
            return record
        return made._make(parts) if hasattr(made, "_make") else kind(parts)
    if form is _MAPPING:
        values = {name: map_leaves(function, value, *[each[name] for each in rest]) for name, value in made.items()}
        return record if all(values[name] is value for name, value in made.items()) else kind({**made, **values})
    values, same = {}, True
    for name in form:
        value = new = getattr(made, name)
        if rest:
            new = map_leaves(function, value, *[getattr(each, name) for each in rest])
        elif type(value) is Tensor:  # what most fields of a small record are
            new = function(value)
        elif value is not None:
            new = map_leaves(function, value)
        same = same and new is value
        values[name] = new
    return record if same else kind(**values)


def rebuild(record: T, tensors: Sequence[Tensor]) -> T:
    """Return a record with ``tensors`` in the places of its :func:`leaves`.

    Raises:
        ValueError: there are more or fewer of them.
    """
    count = len(leaves(record))
    if count != len(tensors):
        raise ValueError(f"{len(tensors)} tensors for a record of {count}")
    each = iter(tensors)
    return map_leaves(lambda _: next(each), record)


def signature(record: Any) -> Any:
    """Return what code that is specialized for a record may ask of it beside the numbers in its leaves: hashable.

    Objects of a user's own count by identity, by the plain numbers that they hold, and by which tensors: what is in those is
    memory, and those that a program reads live as long as it does.
    """
    kind = type(record)
    form = _known.get(kind)
    if form is None:
        form = _form(kind)
    if form is _TENSOR:
        return record.dtype, tuple(record.shape)
    if form is _SEQUENCE:
        return tuple([signature(value) for value in record])
    if form is _MAPPING:
        return tuple([(name, signature(value)) for name, value in record.items()])
    if form is not _STATIC:
        return kind, tuple([(name, signature(getattr(record, name))) for name in form])
    return record if _is_plain(record) else (record, _contents(record, set()))


def _is_plain(value: Any) -> bool:
    return value is None or isinstance(value, bool | int | float | str | bytes | type | torch.dtype)


def _contents(value: Any, seen: set[int]) -> Any:
    """Return what an object of a user's own holds, see :func:`signature`."""
    if _is_plain(value):
        return value
    if id(value) in seen:
        return None
    if isinstance(value, Tensor):
        return id(value), value.dtype, tuple(value.shape)
    seen = seen | {id(value)}
    if isinstance(value, dict):
        return tuple((str(key), _contents(item, seen)) for key, item in value.items())
    if isinstance(value, tuple | list):
        return tuple(_contents(item, seen) for item in value)
    return id(value), _contents(getattr(value, "__dict__", {}), seen)


# -- fingerprints

#: Whose code is known by its name: versions of these are told beside a fingerprint, or change no number.
_LIBRARIES = {"torchpt", "torch", "numpy", "builtins", *sys.stdlib_module_names}


def fingerprint(record: Any) -> bytes:
    """Return 16 bytes that two records share where all that they hold is equal, in any process and on any device.

    It goes by types, values, and the bytes of tensors and arrays; fields that say :data:`NOT_FINGERPRINTED` are left out. Of classes
    and functions of a user's own it takes the code, comments apart, with the functions and plain values of their modules that
    the code names.

    Raises:
        TypeError: something whose contents cannot be known, such as a lock or an open file.
    """
    return _Fingerprinter().digest(record)


class _Fingerprinter:
    """One call of :func:`fingerprint`."""

    def __init__(self) -> None:
        self._printed: dict[int, tuple[Any, bytes]] = {}  # objects live as long as their ids are of use
        self._open: dict[int, int] = {}  # depth of the objects that hold the present one

    def digest(self, value: Any) -> bytes:
        """Return that of anything."""
        return _hash(self._encoded(value))

    def _encoded(self, value: Any) -> bytes:
        """Return bytes that no other value has; of what is large its hash."""
        if value is None:
            return b"0"
        kind = type(value)
        if kind is float:
            return b"f" + struct.pack("<d", value)
        if kind is str:
            return b"s" + _sized(value.encode("utf-8", "surrogatepass"))
        if kind is bool or kind is int:
            return b"i" + _sized(repr(value).encode())
        if kind is bytes:
            return b"b" + _sized(value)
        known = self._printed.get(id(value))
        if known is not None:
            return known[1]
        if id(value) in self._open:
            return b"^" + _sized(str(len(self._open) - self._open[id(value)]).encode())
        self._open[id(value)] = len(self._open)
        try:
            found = _hash(self._large(value))
        finally:
            del self._open[id(value)]
        self._printed[id(value)] = value, found
        return found

    def _large(self, value: Any) -> bytes:
        """Return what stands for a value that holds others, or many numbers."""
        if isinstance(value, Tensor):
            value = value.detach().cpu().resolve_conj().resolve_neg().contiguous()
            numbers = value.reshape(-1).view(torch.uint8).numpy()
            return _named("tensor", value.dtype, tuple(value.shape)) + _hash(numbers.data)
        if isinstance(value, np.ndarray | np.generic) and value.dtype != object:
            array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
            return _named("array", array.dtype.str, np.shape(value)) + _hash(array.reshape(-1).view(np.uint8).data)
        if isinstance(value, np.ndarray):
            return _named("objects", value.shape) + self._each(value.reshape(-1).tolist())
        if isinstance(value, enum.Enum):
            return self._class(type(value)) + self._encoded(value.name)
        if isinstance(value, int | float | str | bytes):  # of classes derived from these
            plain = next(base for base in (int, float, str, bytes) if isinstance(value, base))
            return self._class(type(value)) + self._encoded(cast("Any", plain)(value))
        if isinstance(value, PurePath):
            return b"path" + self._encoded(str(value))
        if isinstance(value, torch.dtype | torch.device | types.ModuleType):
            return _named("name", str(getattr(value, "__name__", value)))
        if isinstance(value, type):
            return self._class(value)
        if isinstance(value, Mapping):
            return b"mapping" + self._each(part for item in value.items() for part in item)
        if isinstance(value, set | frozenset):
            return b"set" + b"".join(sorted(_hash(self._encoded(part)) for part in value))
        if type(value) in (tuple, list):
            return b"sequence" + self._each(value)
        return self._object(value)

    def _object(self, value: Any) -> bytes:
        if isinstance(value, functools.partial):
            return b"partial" + self._each((value.func, value.args, value.keywords))
        if isinstance(value, types.MethodType):
            return b"method" + self._each((value.__func__, value.__self__))
        if isinstance(value, types.FunctionType):
            return b"function" + self._function(value)
        if isinstance(value, types.BuiltinFunctionType):
            return _named("builtin", value.__module__, value.__qualname__)
        if isinstance(value, staticmethod | classmethod | property | functools.cached_property):
            held = (getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "func"))
            return self._class(type(value)) + self._each(held)
        if is_dataclass(value) and not isinstance(value, torch.nn.Module):
            state = {field.name: getattr(value, field.name) for field in fields(value)}
            if _is_own(type(value)):
                state |= _state(value)
            state = {name: item for name, item in state.items() if name not in _unprinted(type(value))}
        elif hasattr(value, "__dict__") or hasattr(type(value), "__slots__"):
            state = _state(value)
        else:
            reduced = value.__reduce_ex__(4)
            state = {"": reduced if isinstance(reduced, str) else reduced[1:3]}
        if isinstance(value, tuple | list):  # such as a named tuple
            state[""] = [*value]
        return (
            b"object" + self._class(type(value)) + self._each(part for item in sorted(state.items()) for part in item)
        )

    def _class(self, kind: type) -> bytes:
        """Return what stands for a class: its name, and where it is a user's own the code of its methods."""
        name = _named("class", kind.__module__, kind.__qualname__)
        if not _is_own(kind):
            return name
        members = {
            key: value
            for key, value in vars(kind).items()
            if not (key.startswith("__") and isinstance(value, str | dict | tuple | types.GetSetDescriptorType | None))
            and key not in ("__weakref__", "__firstlineno__", "__abstractmethods__", "_abc_impl")
        }
        return name + self._each((*kind.__bases__, *(part for item in sorted(members.items()) for part in item)))

    def _function(self, function: types.FunctionType) -> bytes:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
        held = self._each((function.__defaults__, function.__kwdefaults__, cells))
        if not _is_own(function):
            return _named("name", function.__module__, function.__qualname__) + held
        return held + self._code(function.__code__, function.__globals__)

    def _code(self, code: types.CodeType, around: Mapping[str, Any]) -> bytes:
        """Return what stands for code: instructions, constants, names, and what those mean around it."""
        inner = [self._code(part, around) if isinstance(part, types.CodeType) else part for part in code.co_consts]
        named = [around.get(name) for name in code.co_names]
        read = [
            value
            for value in named
            if isinstance(value, type | types.FunctionType | Tensor | np.ndarray) or _is_plain(value)
        ]
        return self._each((code.co_code, code.co_names, code.co_freevars, inner, read))

    def _each(self, values: Any) -> bytes:
        return _hash(b"".join([self._encoded(value) for value in values]))


def _hash(content: Any) -> bytes:
    return hashlib.blake2b(content, digest_size=16).digest()


def _sized(content: bytes) -> bytes:
    return b"%d:%b" % (len(content), content)


def _named(*words: Any) -> bytes:
    return _sized(repr(words).encode())


def _is_own(code: Any) -> bool:
    """Return True for a class or function that no library defines."""
    return str(code.__module__).partition(".")[0] not in _LIBRARIES


@functools.cache
def _unprinted(kind: Any) -> frozenset[str]:
    """Return the fields of a dataclass that are left out."""
    return frozenset(field.name for field in fields(kind) if not field.metadata.get("fingerprint", True))


def _state(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, what it only keeps of its own results apart."""
    kinds = type(value).__mro__
    slots = [name for kind in kinds for name in _names(kind) if hasattr(value, name)]
    state = {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})
    kept = {name for kind in kinds for name, item in vars(kind).items() if isinstance(item, functools.cached_property)}
    return {name: item for name, item in state.items() if name not in kept and name != "__weakref__"}


def _names(kind: type) -> Sequence[str]:
    slots = vars(kind).get("__slots__", ())
    return [slots] if isinstance(slots, str) else list(slots)
