"""What two worlds must have in common to be joined."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import fields, is_dataclass
from typing import Any

from torch import Tensor

from torchpt.bsdfs import Bsdf
from torchpt.core.tree import leaves
from torchpt.records import World

__all__ = ["form_of"]


def form_of(world: World) -> Hashable:
    """What is static in a world, and which of its tensors are there: equal where worlds can be joined.

    Records name those of their static fields that may differ in ``counted``.
    """
    return _form(world)


def _form(value: Any) -> Hashable:
    if isinstance(value, Tensor):
        return value.dtype, value.dim()
    if isinstance(value, dict):
        return tuple(sorted((key, _form(item)) for key, item in value.items()))
    if isinstance(value, tuple | list):
        return tuple(_form(item) for item in value)
    if is_dataclass(value) and not isinstance(value, type | Bsdf) and leaves(value):
        counted = getattr(value, "counted", ())
        return type(value), tuple(_form(getattr(value, f.name)) for f in fields(value) if f.name not in counted)
    # The hash first, as in a dict: a model may hold tensors, which two of can not be compared.
    return hash(value), value
