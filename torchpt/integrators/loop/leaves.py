"""The tensors that a render's kernels read, by name, and which of them another render has read before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

from torch import Tensor

__all__ = ["Leaves", "leaves_of"]


def leaves_of(record: Any, path: str) -> Iterator[tuple[str, Tensor]]:
    """All tensors of a record by path."""
    if isinstance(record, Tensor):
        yield path, record
    elif isinstance(record, dict):
        for name, value in record.items():
            yield from leaves_of(value, f"{path}.{name}")
    elif isinstance(record, tuple | list):
        for k, value in enumerate(record):
            yield from leaves_of(value, f"{path}.{k}")
    elif is_dataclass(record):
        for field in fields(record):
            yield from leaves_of(getattr(record, field.name), f"{path}.{field.name}")


class Leaves:
    """The tensors of some records.

    Args:
        records: by the name that the paths begin with.

    Attributes:
        tensors: by path.
        ids: path and tensor by the tensor's id.
    """

    def __init__(self, records: dict[str, Any]) -> None:
        self.tensors = dict(leaf for name, record in records.items() for leaf in leaves_of(record, name))
        self.ids = {id(tensor): (path, tensor) for path, tensor in self.tensors.items()}
        # A tensor is the same one only as long as nobody wrote into it; of inference tensors that cannot be known.
        self._states = {
            path: (id(tensor), object() if tensor.is_inference() else tensor._version)
            for path, tensor in self.tensors.items()
        }

    def unchanged(self, before: Leaves) -> set[str]:
        """Paths of the tensors that are those of another render, with the same numbers; both have the same paths."""
        return {path for path, state in self._states.items() if before._states[path] == state}
