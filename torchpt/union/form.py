"""What two worlds must have in common to be joined."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, is_dataclass
from typing import Any

from torch import Tensor

from torchpt.bsdfs import Bsdf
from torchpt.records import World, tensors_of

__all__ = ["form_of", "size_of"]

#: What is static in a record but may differ: how many there are of something.
_NUMBERS = frozenset({"counts", "height", "levels", "rows", "width"})


def form_of(world: World) -> Hashable:
    """What is static in a world, and which of its tensors are there: equal where worlds can be joined."""
    return _form(world)


def size_of(world: World) -> int:
    """Bytes of its tensors."""
    return sum(tensor.nbytes for tensor in tensors_of(world))


def _form(value: Any) -> Hashable:
    if isinstance(value, Tensor):
        return value.dtype, value.dim()
    if isinstance(value, dict):
        return tuple(sorted((key, _form(item)) for key, item in value.items()))
    if isinstance(value, tuple | list):
        return tuple(_form(item) for item in value)
    if is_dataclass(value) and not isinstance(value, type | Bsdf):
        return type(value), tuple(_form(getattr(value, f.name)) for f in fields(value) if not _number(value, f.name))
    return value


def _number(record: Any, name: str) -> bool:
    return name in _NUMBERS and not isinstance(getattr(record, name), Tensor)
