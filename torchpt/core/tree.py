"""Nested records: dataclasses, tuples, lists and mappings that hold tensors and other values.

A record's *leaves* are its tensors, in the order of its fields. Modules and other objects of a user are opaque: their tensors
are no leaves. Only :func:`fingerprint` looks into them.
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

__all__ = ["NOT_FINGERPRINTED", "fingerprint", "leaves", "map_leaves", "moved", "named_leaves", "rebuild", "signature"]

T = TypeVar("T")

#: ``field(metadata=NOT_FINGERPRINTED)`` for a dataclass field on which no picture depends, such as the path of a file.
NOT_FINGERPRINTED = {"fingerprint": False}

#: How instances of a class are walked: a leaf, by values, by items, not at all. Those of a dataclass: by the names of its
#: fields.
_TENSOR, _MAPPING, _SEQUENCE, _STATIC = range(4)
#: One of the above, or a tuple of names, for each class met so far. Walks look it up inline: a call would cost them much time.
_forms: dict[type, Any] = {}


def _form(kind: type) -> Any:
    """Return how instances of a class are walked, and remember it."""
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
    _forms[kind] = form
    return form


def leaves(record: Any) -> list[Tensor]:
    """Return the tensors of a record, in order; one that occurs twice is returned twice."""
    found: list[Tensor] = []
    _gather(record, found)
    return found


def _gather(record: Any, found: list[Tensor]) -> None:
    """Append the leaves of a record to ``found``."""
    kind = type(record)
    form = _forms.get(kind)
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
    """Yield dotted path and tensor of each leaf, in the order of :func:`leaves`; paths begin with ``path``."""
    kind = type(record)
    form = _forms.get(kind)
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
    """Return a record whose leaves are ``function`` of the leaves of ``record`` and of the corresponding ones of ``others``.

    Records in it without a changed leaf are not copied.
    """
    old, old_others = cast("Any", record), cast("Sequence[Any]", others)  # the type checker does not follow forms
    kind: Any = type(old)
    form = _forms.get(kind)
    if form is None:
        form = _form(kind)
    if form is _TENSOR:
        return function(old, *old_others)
    if form is _STATIC:
        return record
    if form is _SEQUENCE:
        items = [map_leaves(function, *corresponding) for corresponding in zip(old, *old_others, strict=True)]
        if all(new is value for new, value in zip(items, old, strict=True)):
            return record
        return old._make(items) if hasattr(old, "_make") else kind(items)  # _make: of a named tuple
    if form is _MAPPING:
        values = {
            name: map_leaves(function, value, *[other[name] for other in old_others]) for name, value in old.items()
        }
        return record if all(values[name] is value for name, value in old.items()) else kind({**old, **values})
    values, unchanged = {}, True
    for name in form:
        value = new = getattr(old, name)
        if old_others:
            new = map_leaves(function, value, *[getattr(other, name) for other in old_others])
        elif type(value) is Tensor:  # the most frequent case, without a call
            new = function(value)
        elif value is not None:
            new = map_leaves(function, value)
        unchanged = unchanged and new is value
        values[name] = new
    return record if unchanged else kind(**values)


def moved(record: T, device: torch.device, known: dict[int, Tensor] | None = None) -> T:
    """Return a record whose leaves are on a device; a tensor that occurs twice is copied once. Gradients flow back.

    Args:
        record: the record; its own leaves live as long as it does.
        device: the device.
        known: tensors of the device by the id of a leaf, used in place of new copies; new ones are added.
    """
    copies = {} if known is None else known

    def copy_of(tensor: Tensor) -> Tensor:
        found = copies.get(id(tensor))
        if found is None:
            found = copies[id(tensor)] = tensor.to(device)
        return found

    return map_leaves(copy_of, record)


def rebuild(record: T, tensors: Sequence[Tensor]) -> T:
    """Return a record whose :func:`leaves` are replaced by ``tensors``, in order.

    Raises:
        ValueError: their number differs.
    """
    count = len(leaves(record))
    if count != len(tensors):
        raise ValueError(f"{len(tensors)} tensors for a record of {count}")
    remaining = iter(tensors)
    return map_leaves(lambda _: next(remaining), record)


def signature(record: Any) -> Any:
    """Return a hashable key of everything in a record but the values of its leaves: compiled code for it is kept by this key.

    A user's objects count by identity, by the plain values that they hold, and by the identity of their tensors: compiled code
    reads those from memory, and keeps them alive.
    """
    kind = type(record)
    form = _forms.get(kind)
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


def _contents(value: Any, around: set[int]) -> Any:
    """Return the contents of a user's object for :func:`signature`; ``around`` are ids of the objects that it lies in."""
    if _is_plain(value):
        return value
    if id(value) in around:  # a cycle
        return None
    if isinstance(value, Tensor):
        return id(value), value.dtype, tuple(value.shape)
    around = around | {id(value)}
    if isinstance(value, dict):
        return tuple((str(key), _contents(item, around)) for key, item in value.items())
    if isinstance(value, tuple | list):
        return tuple(_contents(item, around) for item in value)
    return id(value), _contents(getattr(value, "__dict__", {}), around)


# -- fingerprints

#: Libraries whose code is identified by name: their versions are stored with a fingerprint, or do not matter.
_LIBRARIES = {"torchpt", "torch", "numpy", "builtins", *sys.stdlib_module_names}


def fingerprint(record: Any) -> bytes:
    """Return a hash of 16 bytes, the same for equal records in any process and on any device.

    It covers types, values, and the bytes of tensors and arrays, but no field marked :data:`NOT_FINGERPRINTED`. Classes and
    functions of a user count by their code without comments, with the functions and plain values of their module that the
    code names.

    Raises:
        TypeError: an object whose contents cannot be read, such as a lock or an open file.
    """
    return _Fingerprinter().digest(record)


class _Fingerprinter:
    """One call of :func:`fingerprint`.

    Each value is encoded as bytes that begin with a letter or word for its type; what varies in length is preceded by its
    length, so that no two sequences of values have the same bytes.
    """

    def __init__(self) -> None:
        # Objects and their encoding by id: an object that occurs twice is hashed once. Keeps them alive, so that ids stay
        # unique.
        self._encodings: dict[int, tuple[Any, bytes]] = {}
        self._depths: dict[int, int] = {}  # by id: the depths of the objects that the current one lies in

    def digest(self, value: Any) -> bytes:
        """Return the fingerprint of a value."""
        return _hash(self._encoded(value))

    def _encoded(self, value: Any) -> bytes:
        """Return bytes that identify a value; of large values their hash."""
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
        if id(value) in self._encodings:
            _, encoding = self._encodings[id(value)]
            return encoding
        if id(value) in self._depths:  # a cycle: how many levels up it leads
            return b"^" + _sized(str(len(self._depths) - self._depths[id(value)]).encode())
        self._depths[id(value)] = len(self._depths)
        try:
            encoding = _hash(self._large(value))
        finally:
            del self._depths[id(value)]
        self._encodings[id(value)] = value, encoding
        return encoding

    def _large(self, value: Any) -> bytes:
        """Return bytes that identify a container, a tensor or an object."""
        if isinstance(value, Tensor):
            value = value.detach().cpu().resolve_conj().resolve_neg().contiguous()
            numbers = value.reshape(-1).view(torch.uint8).numpy()
            return _named("tensor", value.dtype, tuple(value.shape)) + _hash(numbers.data)
        if isinstance(value, np.ndarray | np.generic) and value.dtype != object:  # generic: numpy's scalars
            array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
            return _named("array", array.dtype.str, np.shape(value)) + _hash(array.reshape(-1).view(np.uint8).data)
        if isinstance(value, np.ndarray):
            return _named("objects", value.shape) + self._each(value.reshape(-1).tolist())
        if isinstance(value, enum.Enum):
            return self._class(type(value)) + self._encoded(value.name)
        if isinstance(value, int | float | str | bytes):  # subclasses
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
            functions = (getattr(value, name, None) for name in ("__func__", "fget", "fset", "fdel", "func"))
            return self._class(type(value)) + self._each(functions)
        if is_dataclass(value) and not isinstance(value, torch.nn.Module):
            state = {field.name: getattr(value, field.name) for field in fields(value)}
            if _is_user_code(type(value)):
                state |= _state(value)  # attributes that are no fields
            state = {name: item for name, item in state.items() if name not in _not_fingerprinted(type(value))}
        elif hasattr(value, "__dict__") or hasattr(type(value), "__slots__"):
            state = _state(value)
        else:  # as pickle sees it: a global's name, or (callable, arguments, state, ...)
            reduced = value.__reduce_ex__(4)
            state = {"": reduced if isinstance(reduced, str) else reduced[1:3]}
        if isinstance(value, tuple | list):  # for example a named tuple
            state[""] = [*value]
        return (
            b"object" + self._class(type(value)) + self._each(part for item in sorted(state.items()) for part in item)
        )

    def _class(self, kind: type) -> bytes:
        """Return bytes that identify a class: its name, and the code of its methods if it is a user's."""
        name = _named("class", kind.__module__, kind.__qualname__)
        if not _is_user_code(kind):
            return name
        # Without docstrings, line numbers and what Python adds by itself.
        members = {
            key: value
            for key, value in vars(kind).items()
            if not (key.startswith("__") and isinstance(value, str | dict | tuple | types.GetSetDescriptorType | None))
            and key not in ("__weakref__", "__firstlineno__", "__abstractmethods__", "_abc_impl")
        }
        return name + self._each((*kind.__bases__, *(part for item in sorted(members.items()) for part in item)))

    def _function(self, function: types.FunctionType) -> bytes:
        """Return bytes that identify a function: defaults, the variables that it captures, and its name or a user's code."""
        captured = [cell.cell_contents for cell in function.__closure__ or ()]
        values = self._each((function.__defaults__, function.__kwdefaults__, captured))
        if not _is_user_code(function):
            return _named("name", function.__module__, function.__qualname__) + values
        return values + self._code(function.__code__, function.__globals__)

    def _code(self, code: types.CodeType, global_values: Mapping[str, Any]) -> bytes:
        """Return bytes that identify code: instructions, constants, names, and the values of the globals that it names."""
        # Constants of a code object include the code of functions that are defined in it.
        constants = [
            self._code(constant, global_values) if isinstance(constant, types.CodeType) else constant
            for constant in code.co_consts
        ]
        named = [global_values.get(name) for name in code.co_names]
        read = [
            value
            for value in named
            if isinstance(value, type | types.FunctionType | Tensor | np.ndarray) or _is_plain(value)
        ]
        return self._each((code.co_code, code.co_names, code.co_freevars, constants, read))

    def _each(self, values: Any) -> bytes:
        """Return the hash of a sequence of values."""
        return _hash(b"".join([self._encoded(value) for value in values]))


def _hash(content: Any) -> bytes:
    return hashlib.blake2b(content, digest_size=16).digest()


def _sized(content: bytes) -> bytes:
    """Return content after its length in bytes."""
    return b"%d:%b" % (len(content), content)


def _named(*words: Any) -> bytes:
    """Return bytes that identify plain values by their ``repr``."""
    return _sized(repr(words).encode())


def _is_user_code(code: Any) -> bool:
    """Return True for a class or function that no library defines."""
    return str(code.__module__).partition(".")[0] not in _LIBRARIES


@functools.cache
def _not_fingerprinted(kind: Any) -> frozenset[str]:
    """Return the fields of a dataclass that fingerprints leave out."""
    return frozenset(field.name for field in fields(kind) if not field.metadata.get("fingerprint", True))


def _state(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, without cached properties."""
    kinds = type(value).__mro__
    slots = [name for kind in kinds for name in _slot_names(kind) if hasattr(value, name)]
    state = {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})
    cached = {
        name for kind in kinds for name, item in vars(kind).items() if isinstance(item, functools.cached_property)
    }
    return {name: item for name, item in state.items() if name not in cached and name != "__weakref__"}


def _slot_names(kind: type) -> Sequence[str]:
    """Return the names in ``__slots__`` of a class, which may be one name or several."""
    slots = vars(kind).get("__slots__", ())
    return [slots] if isinstance(slots, str) else list(slots)
