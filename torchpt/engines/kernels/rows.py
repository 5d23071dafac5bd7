"""What the rows of an arena hold: the numbers of a path's state, of a hit, of a shadow ray."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.integrators.vertex import EXTRA
from torchpt.lanes.arena import CAPACITY
from torchpt.lanes.graph import DTYPES
from torchpt.lanes.tracing import Tracer
from torchpt.records import PathState

__all__ = ["HIT", "PASS", "SHADOW", "SPLAT", "Fields", "Memory", "Rows", "path_state", "state_values"]

#: Shape without lanes and node type of each field.
Fields = dict[str, tuple[tuple[int, ...], str]]

#: Fields of a hit, of a shadow ray, and of a ray that goes on behind a surface that it passed.
HIT: Fields = {"t": ((), "f"), "prim": ((), "l"), "u": ((), "f"), "v": ((), "f")}
SHADOW: Fields = {
    "shadow_o": ((3,), "f"),
    "shadow_d": ((3,), "f"),
    "shadow_t": ((), "f"),
    "shadow_radiance": ((3,), "f"),
}
#: Fields of light to another pixel: its shadow ray, and how much of it gets through.
SPLAT: Fields = {
    "splat_pixel": ((), "l"),
    "splat_o": ((3,), "f"),
    "splat_d": ((3,), "f"),
    "splat_t": ((), "f"),
    "splat_radiance": ((3,), "f"),
    "splat_clear": ((), "f"),
}
PASS: Fields = {
    "pass_o": ((3,), "f"),
    "pass_d": ((3,), "f"),
    "pass_t": ((), "f"),
    "before": ((), "f"),
    "home": ((), "l"),
}

#: Fields of a path's state, those apart.
_STATE = tuple(field.name for field in fields(PathState) if field.name != "extra")

_DTYPES = {ty: dtype for dtype, ty in DTYPES.items()}


def path_state(given: Mapping[str, Tensor]) -> PathState:
    """Return paths from tensors by the names of rows; other names are passed over."""
    extra = {name.removeprefix(EXTRA): value for name, value in given.items() if name.startswith(EXTRA)}
    known: dict[str, Any] = {name: value for name, value in given.items() if name in _STATE}
    return PathState(**known, extra=extra)


def state_values(state: PathState) -> dict[str, Tensor]:
    """Return tensors of paths by the names of rows."""
    values = {name: getattr(state, name) for name in _STATE}
    extra = {EXTRA + name: value for name, value in state.extra.items()}
    return {name: value for name, value in values.items() if value is not None} | extra


class Memory:
    """Rows of 32-bit words, each with some to spare: kernels write whole vectors."""

    def __init__(self, rows: int) -> None:
        self.words = np.zeros((rows, CAPACITY), np.int32)
        self.floats = self.words.view(np.float32)
        self.address = self.words.ctypes.data


class Rows:
    """Rows of an arena by the names of the fields that they hold.

    Args:
        fields: of the arena.

    Attributes:
        count: how many rows there are.
    """

    def __init__(self, fields: Fields) -> None:
        self._fields = fields
        self._first: dict[str, int] = {}
        self.count = 0
        for name, (shape, _) in fields.items():
            self._first[name] = self.count
            self.count += math.prod(shape)

    def __contains__(self, name: str) -> bool:
        return name in self._fields

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the rows that hold a path's state."""
        return tuple(name for name in self._fields if name in _STATE or name.startswith(EXTRA))

    def first(self, name: str) -> int:
        """The first row of a field."""
        return self._first[name]

    def read(self, tracer: Tracer, *names: str, place: int | None = None) -> dict[str, Tensor]:
        """Fields as inputs of a trace; those that there are not are left out.

        ``place``: node of where they lie in the slots; None: they are the arena's, at the lane's own place.
        """
        inputs: dict[str, Tensor] = {}
        for name in names:
            if name not in self._fields:
                continue
            shape, ty = self._fields[name]
            first, size = self._first[name], (*shape, tracer.lanes)
            dtype = _DTYPES[ty]
            # The numbers are of no consequence: a trace asks for what is done, not for what comes out.
            like = torch.rand(size) + 0.25 if dtype.is_floating_point else torch.zeros(size, dtype=dtype)

            def node(k: int, first: int = first, ty: str = ty) -> int:
                if place is not None:
                    return tracer.graph.node("slot", ty, place, extra=first + k)
                return tracer.graph.node("arena", ty, extra=first + k)

            inputs[name] = tracer.lane(like, node)
        return inputs

    def take(self, memory: Memory, lanes: np.ndarray, names: tuple[str, ...]) -> dict[str, Tensor]:
        """Fields of some lanes as tensors; those that there are not are left out."""
        values = {}
        for name in names:
            if name in self._fields:
                shape, ty = self._fields[name]
                held = memory.floats if ty == "f" else memory.words
                first = self._first[name]
                value = torch.from_numpy(held[first : first + math.prod(shape), lanes]).to(_DTYPES[ty])
                values[name] = value.view(*shape, len(lanes))
        return values

    def put(self, memory: Memory, start: int, values: dict[str, Tensor | None]) -> None:
        """Fields of consecutive lanes from tensors; those that there are not are left out."""
        for name, value in values.items():
            if name in self._fields and value is not None:
                shape, ty = self._fields[name]
                held = memory.floats if ty == "f" else memory.words
                first = self._first[name]
                rows = value.reshape(math.prod(shape), -1)
                held[first : first + len(rows), start : start + rows.shape[1]] = rows.numpy()

    def nodes(self, tracer: Tracer, **fields: Tensor) -> list[tuple[int, int]]:
        """Rows and nodes of results by field; numbers that all lanes share are spread."""
        pairs = []
        for name, value in fields.items():
            shape, ty = self._fields[name]
            nodes = tracer.nodes(value)
            if len(nodes) != math.prod(shape):
                raise ValueError(f"{name}: {len(nodes)} numbers for {math.prod(shape)} rows")
            held = ty if ty != "l" else None
            pairs += [
                (self._first[name] + k, node if held is None else tracer.graph.cast(node, held))
                for k, node in enumerate(nodes)
            ]
        return pairs
