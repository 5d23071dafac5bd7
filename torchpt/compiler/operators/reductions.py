"""Lowerings of reductions: over axes other than the lanes', and in backward passes of sums over lanes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.compiler.graph import DTYPES, Unsupported
from torchpt.compiler.operators.arithmetic import binary
from torchpt.compiler.operators.derivatives import sum_over_lanes
from torchpt.compiler.operators.nodes import cast_all, type_of
from torchpt.compiler.tracing import Tracer, register_lowering

__all__: list[str] = []


def _axes(axis: Any, rank: int) -> list[int]:
    """Return the reduced axes of a call, ascending and not negative; all where torch's ``dim`` is None or empty."""
    if axis is None or axis in ((), []):
        return list(range(rank))
    return sorted(a % rank for a in ([axis] if isinstance(axis, int) else axis))


def _reduce(op: str, boolean: bool = False) -> Any:
    """Return the lowering of a reduction by the binary node ``op``; ``boolean``: of values as booleans (node type "b")."""

    def handler(
        tracer: Tracer, out: Tensor, a: Tensor, axis: Any = None, keepdim: bool = False, dtype: Any = None
    ) -> None:
        value, graph = tracer.get(a), tracer.graph
        nodes = value.nodes
        for k in reversed(_axes(axis, nodes.ndim)):
            if k == value.lane:
                if op != "add" or not tracer.graph.derivatives:
                    raise Unsupported("a reduction over lanes")
                summed = sum_over_lanes(tracer, nodes, k, DTYPES[out.dtype])
                nodes = np.expand_dims(summed, k) if keepdim else summed
                continue
            # Slices of the array of nodes along the axis; squeezed, so that a slice of a vector is an array of no axes.
            parts: list[Any] = [np.squeeze(np.take(nodes, [j], axis=k), axis=k) for j in range(nodes.shape[k])]
            if not parts:
                shape = (*nodes.shape[:k], *nodes.shape[k + 1 :])
                parts = [np.full(shape, _neutral_element(graph, op, DTYPES[out.dtype]), object)]
            total = cast_all(tracer, parts[0], "b" if boolean else _type_of_sums(op, out))
            for part in parts[1:]:
                joined: Any = np.empty(total.shape, object)
                for entry in np.ndindex(*total.shape):
                    ty = "b" if boolean else type_of(tracer, out.dtype, total[entry], part[entry])
                    joined[entry] = graph.binary(op, ty, graph.cast(total[entry], ty), graph.cast(part[entry], ty))
                total = joined
            nodes = np.expand_dims(total, k) if keepdim else total
        tracer.put(out, cast_all(tracer, nodes, DTYPES[out.dtype]))

    return handler


def _type_of_sums(op: str, out: Tensor) -> str:
    """Return the node type in which a reduction is computed: "L" (64 bits) for int64 sums and products, else that of `out`."""
    return "L" if out.dtype == torch.int64 and op in ("add", "mul") else DTYPES[out.dtype]


def _neutral_element(graph: Any, op: str, ty: str) -> int:
    """Return the result of a reduction of no elements."""
    if op not in ("add", "mul", "and", "or"):
        raise Unsupported("the maximum or minimum of no elements")
    return graph.constant(ty, 1 if op in ("mul", "and") else 0)


register_lowering("amax")(_reduce("max"))
register_lowering("amin")(_reduce("min"))
register_lowering("sum")(_reduce("add"))
register_lowering("prod")(_reduce("mul"))
register_lowering("all")(_reduce("and", boolean=True))
register_lowering("any")(_reduce("or", boolean=True))


@register_lowering("mean")
def _mean(tracer: Tracer, out: Tensor, a: Tensor, axis: Any = None, keepdim: bool = False, dtype: Any = None) -> None:
    _reduce("add")(tracer, out, a, axis=axis, keepdim=keepdim)
    count = math.prod(a.shape[k] for k in _axes(axis, a.dim()))
    binary("div")(tracer, out, out, count)  # the sum, now in `out`, over the count


@register_lowering("cumsum")
def _cumsum(tracer: Tracer, out: Tensor, a: Tensor, axis: int, dtype: Any = None) -> None:
    value, graph, ty = tracer.get(a), tracer.graph, _type_of_sums("add", out)
    axis %= a.dim()
    if axis == value.lane:
        raise Unsupported("a sum over lanes")
    nodes = np.moveaxis(cast_all(tracer, value.nodes, ty), axis, 0).copy()
    for k in range(1, len(nodes)):
        for entry in np.ndindex(*nodes.shape[1:]):
            nodes[(k, *entry)] = graph.binary("add", ty, nodes[(k - 1, *entry)], nodes[(k, *entry)])
    tracer.put(out, np.moveaxis(nodes, 0, axis))
