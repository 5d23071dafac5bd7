"""The graph of a stage: its nodes are scalar operations, each with one value a lane.

Types are one letter: ``f`` float32, ``d`` float64, ``i`` int32, ``b`` bool, ``u`` uint8 held in 32 bits. Nodes of int64 tensors
have one of two types: ``l`` for indices, which fit in 32 bits and are held in 32, and ``L`` for products, powers, shifts and
conversions from int32 lanes, which may need all 64 bits. (LLVM narrows a product to 32 bits where it is used as an index.)

``codegen.py`` lists the operations in ``_HANDLERS``, with the meaning of ``extra`` for those that have it.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import torch

__all__ = ["BYTES", "DTYPES", "FLOATS", "INTEGERS", "Graph", "Unsupported"]


class Unsupported(Exception):
    """An error: a stage uses an operation that the lane compiler cannot compile. The message names it."""


class _Types(dict[torch.dtype, str]):
    def __missing__(self, dtype: torch.dtype) -> str:
        raise Unsupported(f"numbers of type {dtype}")


#: Node type of each dtype; int64 may also be ``L``.
DTYPES = _Types(
    {
        torch.float32: "f",
        torch.float64: "d",
        torch.int32: "i",
        torch.int64: "l",
        torch.bool: "b",
        torch.uint8: "u",
    }
)
#: Types that are floats, and those that are integers.
FLOATS, INTEGERS = "fd", "ilLu"
#: Bytes of an element in tensors.
BYTES = {"f": 4, "d": 8, "i": 4, "l": 8, "L": 8, "b": 1, "u": 1}


class Graph:
    """A list of unique nodes ``(op, type, arguments, extra)``; a node is referred to by its index in the list.

    Attributes:
        nodes: all nodes; ``arguments`` are indices of nodes, which come before their users; ``extra`` holds the constants of
            the operation, such as the row that it loads.
        origins: for each node the package's files on the stack when it was created, innermost first.
        origin: the same for nodes that are added next.
        derivatives: True if a backward pass is traced: sums over lanes become ``total`` nodes, and the sign of 0 is ignored.
    """

    def __init__(self) -> None:
        self.nodes: list[tuple[str, str, tuple[int, ...], Any]] = []
        self.origins: list[tuple[str, ...]] = []
        self.origin: tuple[str, ...] = ()
        self.derivatives = False
        self._known: dict[tuple[str, str, tuple[int, ...], Any], int] = {}

    def node(self, op: str, ty: str, *arguments: int, extra: Any = None) -> int:
        """Return the index of a node, which is added if it is new."""
        key = op, ty, arguments, extra
        number = self._known.get(key)
        if number is None:
            number = self._known[key] = len(self.nodes)
            self.nodes.append(key)
            self.origins.append(self.origin)
        return number

    def type(self, node: int) -> str:
        """Return the type of a node."""
        return self.nodes[node][1]

    def constant(self, ty: str, value: float | int | bool) -> int:
        """Return a node for a constant, the same in all lanes and scenes."""
        if ty in FLOATS:
            with np.errstate(over="ignore"):
                value = float(np.float32(value) if ty == "f" else value)
            return self.node("const", ty, extra=struct.pack("<d", value))  # as bits: 0.0 == -0.0, but NaN != NaN
        if ty == "b":
            return self.node("const", ty, extra=bool(value))
        value = int(value)
        if ty == "i":  # wraps around, as int32 does
            value = (value + (1 << 31)) % (1 << 32) - (1 << 31)
        return self.node("const", ty, extra=value % 256 if ty == "u" else value)

    def value(self, node: int) -> Any:
        """Return the value of a constant; None for other nodes."""
        op, ty, _, extra = self.nodes[node]
        if op != "const":
            return None
        return struct.unpack("<d", extra)[0] if ty in FLOATS else extra

    def cast(self, node: int, ty: str) -> int:
        """Convert a node to another type, as torch converts numbers."""
        own = self.type(node)
        if own == ty:
            return node
        value = self.value(node)
        if value is not None and not (own in FLOATS and ty in INTEGERS and not math.isfinite(value)):
            return self.constant(ty, value != 0 if ty == "b" else value)
        if own in "ilu" and ty in "il":  # the same 32 bits
            return self.node("retype", ty, node)
        return self.node("cast", ty, node)

    def select(self, condition: int, yes: int, no: int) -> int:
        """Select ``yes`` in lanes where the condition holds, else ``no``; both have the same type."""
        if yes == no:
            return yes
        constant = self.value(condition)
        if constant is not None:
            return yes if constant else no
        return self.node("select", self.type(yes), condition, yes, no)

    def binary(self, op: str, ty: str, x: int, y: int) -> int:
        """Return an operation on two nodes of type ``ty``, simplified where that changes no bit of the result."""
        a, b = self.value(x), self.value(y)
        if op in ("mul", "div") and b == 1:
            return x
        if op == "mul" and a == 1:
            return y
        if ty in INTEGERS and op in ("add", "sub", "shl", "ashr", "or", "xor") and b == 0:
            return x
        if ty in INTEGERS and op == "add" and a == 0:
            return y
        if ty in FLOATS:
            if self.derivatives and op == "add" and (a == 0 or b == 0):
                return y if a == 0 else x
            if op in ("max", "min"):
                for constant in (a, b):
                    if constant is not None and math.isnan(constant):
                        return self.constant(ty, constant)
            # A division by a power of two is a multiplication by its reciprocal, exactly, if both are normal numbers.
            largest = 2.0**127 if ty == "f" else 2.0**1023  # the largest power of two
            if op == "div" and b:
                mantissa, _ = math.frexp(b)
                if abs(mantissa) == 0.5 and 1.0 / largest <= abs(b) and abs(1.0 / b) <= largest:
                    return self.node("mul", ty, x, self.constant(ty, 1.0 / b))
            if a is not None and b is not None and op in ("add", "sub", "mul"):
                float_type = np.float32 if ty == "f" else np.float64
                with np.errstate(all="ignore"):
                    p, q = float_type(a), float_type(b)
                    return self.constant(ty, float(p + q if op == "add" else p - q if op == "sub" else p * q))
        return self.node(op, ty, x, y)

    def needed(self, roots: list[int]) -> list[int]:
        """Return all nodes that the roots depend on, arguments first."""
        needed, stack = set(), list(roots)
        while stack:
            node = stack.pop()
            if node not in needed:
                needed.add(node)
                stack += self.nodes[node][2]
        return sorted(needed)
