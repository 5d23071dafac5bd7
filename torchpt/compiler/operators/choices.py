"""Lowerings of comparisons, selection, casts and constants.

The letters of node types (``b``, ``i``, ``l``, ``L``) are those of :mod:`torchpt.compiler.graph`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.graph import DTYPES, FLOATS
from torchpt.compiler.operators.nodes import apply, type_of
from torchpt.compiler.tracing import Tracer, register_lowering

__all__ = ["masked_fill"]


@register_lowering("bitwise_not", "logical_not")
def _not(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph = tracer.graph

    def function(x: int) -> int:
        ty = type_of(tracer, out.dtype, x)
        if ty == "b":
            return graph.node("xor", "b", graph.cast(x, "b"), graph.constant("b", True))
        return graph.node("xor", ty, x, graph.constant(ty, -1))

    apply(tracer, out, function, a)


@register_lowering("isinf")
def _isinf(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[a.dtype]
    if ty not in FLOATS:
        return tracer.put(out, np.array(graph.constant("b", False), object))
    apply(tracer, out, lambda x: graph.node("eq", "b", graph.node("abs", ty, x), graph.constant(ty, math.inf)), a)


@register_lowering("isnan")
def _isnan(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    apply(tracer, out, lambda x: tracer.graph.node("ne", "b", x, x), a)


@register_lowering("isfinite")
def _isfinite(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[a.dtype]
    if ty not in FLOATS:
        return tracer.put(out, np.array(graph.constant("b", True), object))
    apply(tracer, out, lambda x: graph.node("lt", "b", graph.node("abs", ty, x), graph.constant(ty, math.inf)), a)


@register_lowering("where")
def _where(tracer: Tracer, out: Tensor, condition: Tensor, a: Any, b: Any) -> None:
    graph = tracer.graph

    def function(c: int, x: int, y: int) -> int:
        ty = type_of(tracer, out.dtype, x, y)
        return graph.select(graph.cast(c, "b"), graph.cast(x, ty), graph.cast(y, ty))

    apply(tracer, out, function, condition, a, b)


@register_lowering("masked_fill")
def masked_fill(tracer: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> None:
    """Lower ``masked_fill``."""
    _where(tracer, out, mask, value, a)


def _compare(op: str) -> Any:
    """Return the lowering of a comparison to the node ``op``, in the type to which torch promotes the operands."""

    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
        graph, dtype = tracer.graph, torch.result_type(a, b)

        def function(x: int, y: int) -> int:
            ty = type_of(tracer, dtype, x, y)
            return graph.node(op, "b", graph.cast(x, ty), graph.cast(y, ty))

        apply(tracer, out, function, a, b)

    return handler


for _name in ("gt", "lt", "ge", "le", "eq", "ne"):
    register_lowering(_name)(_compare(_name))


@register_lowering("clamp", "clip")
def _clamp(tracer: Tracer, out: Tensor, a: Tensor, low: Any = None, high: Any = None) -> None:
    def function(x: int, *ends: int) -> int:
        graph = tracer.graph
        ty = type_of(tracer, out.dtype, x)
        x = graph.cast(x, ty)
        operations = [op for op, end in (("max", low), ("min", high)) if end is not None]
        for op, end_node in zip(operations, ends, strict=True):
            x = graph.binary(op, ty, x, graph.cast(end_node, ty))
        return x

    apply(tracer, out, function, a, *(end for end in (low, high) if end is not None))


@register_lowering("_to_copy", "to")
def _to_copy(tracer: Tracer, out: Tensor, a: Tensor, *_: Any, **__: Any) -> None:
    def function(x: int) -> int:
        own, ty = tracer.graph.type(x), DTYPES[out.dtype]
        if ty == "l" and own in "iL":
            ty = "L"  # products of converted int32 lanes may need all 64 bits
        return tracer.graph.cast(x, ty)

    apply(tracer, out, function, a)


def _like(value: float) -> Any:
    """Return the lowering of an operator that makes a tensor filled with a value."""

    def handler(tracer: Tracer, out: Tensor, *_: Any, **__: Any) -> None:
        tracer.put(out, np.array(tracer.graph.constant(DTYPES[out.dtype], value), object))

    return handler


register_lowering("ones_like", "new_ones")(_like(1))
register_lowering("zeros_like", "new_zeros")(_like(0))


@register_lowering("full_like", "new_full")
def _full_like(tracer: Tracer, out: Tensor, a: Tensor, *args: Any, **_: Any) -> None:
    value = args[-1]  # new_full has the size before it
    tracer.put(out, np.array(tracer.graph.constant(DTYPES[out.dtype], value), object))
