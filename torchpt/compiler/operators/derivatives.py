"""Lowerings of operators that only autograd's backward passes call.

A parameter that all lanes share has the sum over lanes of derivatives as its gradient. A kernel does not sum over lanes: the
graph marks such sums by ``total`` nodes, and :func:`summand_of` finds what each lane contributes, which the kernel outputs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from torchpt.compiler.graph import DTYPES, Graph, Unsupported
from torchpt.compiler.operators.arithmetic import binary
from torchpt.compiler.operators.choices import masked_fill
from torchpt.compiler.operators.nodes import apply, cast_all
from torchpt.compiler.operators.views import OPEN_END
from torchpt.compiler.tracing import Tracer, register_lowering

__all__ = ["sum_over_lanes", "summand_of"]


def _zeros(tracer: Tracer, out: Tensor) -> tuple[Any, int | None]:
    """Return zero nodes of the shape of ``out``, and its lanes' axis."""
    lane = tracer.lane_axis(out.shape)
    return np.full(tracer.inner(out.shape, lane), tracer.graph.constant(DTYPES[out.dtype], 0), object), lane


@register_lowering("select_backward")
def _select_backward(tracer: Tracer, out: Tensor, cotangent: Tensor, sizes: Any, axis: int, index: int) -> None:
    nodes, lane = _zeros(tracer, out)
    if axis % out.dim() == lane:
        raise Unsupported("the selection of one lane")
    selection: list[Any] = [slice(None)] * out.dim()
    selection[axis] = index
    nodes[tuple(selection)] = tracer.get(cotangent).nodes
    tracer.put(out, nodes, lane)


@register_lowering("slice_backward")
def _slice_backward(
    tracer: Tracer, out: Tensor, cotangent: Tensor, sizes: Any, axis: int, start: int, end: int, step: int
) -> None:
    nodes, lane = _zeros(tracer, out)
    if axis % out.dim() == lane:
        if out.shape != cotangent.shape:
            raise Unsupported("a slice of the lanes' axis")
        return tracer.alias(out, cotangent)
    selection: list[Any] = [slice(None)] * out.dim()
    selection[axis] = slice(start, None if end > OPEN_END else end, step)
    nodes[tuple(selection)] = tracer.get(cotangent).nodes
    tracer.put(out, nodes, lane)


@register_lowering("logical_and_")
def _logical_and_(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor) -> None:
    """Lower the in-selection operator, which the derivative of a clamp calls on a mask that nothing else reads."""
    binary("and")(tracer, out, a, b)
    if out is not a:
        tracer.alias(a, out)


@register_lowering("masked_fill_")
def _masked_fill_(tracer: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> None:
    """Lower the in-selection operator, which the derivative of a maximum calls on a tensor that nothing else reads."""
    masked_fill(tracer, out, a, mask, value)
    if out is not a:
        tracer.alias(a, out)


@register_lowering("sgn")
def _sgn(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    ty = DTYPES[out.dtype]
    apply(tracer, out, lambda x: tracer.graph.node("sign", ty, tracer.graph.cast(x, ty)), a)


@register_lowering("threshold_backward")
def _threshold_backward(tracer: Tracer, out: Tensor, cotangent: Tensor, a: Tensor, threshold: float) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, x: int) -> int:
        below = graph.node("le", "b", graph.cast(x, ty), graph.constant(ty, threshold))
        return graph.select(below, graph.constant(ty, 0), graph.cast(g, ty))

    apply(tracer, out, function, cotangent, a)


@register_lowering("tanh_backward")
def _tanh_backward(tracer: Tracer, out: Tensor, cotangent: Tensor, y: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, t: int) -> int:
        derivative = graph.binary("sub", ty, graph.constant(ty, 1), graph.binary("mul", ty, t, t))  # 1 - tanh^2
        return graph.binary("mul", ty, g, derivative)

    apply(tracer, out, function, cotangent, y)


@register_lowering("sigmoid_backward")
def _sigmoid_backward(tracer: Tracer, out: Tensor, cotangent: Tensor, y: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, s: int) -> int:
        derivative = graph.binary("mul", ty, s, graph.binary("sub", ty, graph.constant(ty, 1), s))
        return graph.binary("mul", ty, g, derivative)

    apply(tracer, out, function, cotangent, y)


def sum_over_lanes(tracer: Tracer, nodes: Any, axis: int, ty: str) -> Any:
    """Return ``total`` nodes of type ``ty``, which stand for the sums over lanes of a tensor whose lanes are on ``axis``."""
    graph = tracer.graph
    nodes = cast_all(tracer, nodes, ty)
    summed = np.empty((*nodes.shape[:axis], *nodes.shape[axis + 1 :]), object)
    parts = np.moveaxis(nodes, axis, 0)
    for entry in np.ndindex(*summed.shape):
        node = parts[(0, *entry)]
        for part in parts[1:]:
            node = graph.binary("add", ty, node, part[entry])
        summed[entry] = graph.node("total", ty, node)
    return summed


def summand_of(graph: Graph, node: int) -> int | None:
    """Return the node that a lane contributes to a sum over lanes, for the node of that sum; None if the sum is 0.

    The sum may have been scaled, negated, selected or added to other sums, which is done to the summands instead.

    Raises:
        Unsupported: the node is no sum over lanes.
    """
    op, ty, arguments, _ = graph.nodes[node]
    if op == "total":
        return arguments[0]
    if op == "const" and graph.value(node) == 0:
        return None
    if op in ("add", "sub"):
        a, b = (summand_of(graph, x) for x in arguments)
        if b is None:
            return a
        b = graph.node("neg", ty, b) if op == "sub" else b
        return b if a is None else graph.binary("add", ty, a, b)
    if op == "neg":
        a = summand_of(graph, arguments[0])
        return None if a is None else graph.node("neg", ty, a)
    if op in ("mul", "div"):  # by a factor that all lanes share
        x, y = arguments
        x_is_sum, y_is_sum = _contains_total(graph, x), _contains_total(graph, y)
        if x_is_sum and not y_is_sum:
            a = summand_of(graph, x)
            return None if a is None else graph.binary(op, ty, a, y)
        if y_is_sum and not x_is_sum and op == "mul":
            a = summand_of(graph, y)
            return None if a is None else graph.binary(op, ty, x, a)
    if op == "select" and not _contains_total(graph, arguments[0]):
        a, b = (summand_of(graph, x) for x in arguments[1:])
        zero = graph.constant(ty, 0)
        return graph.select(arguments[0], zero if a is None else a, zero if b is None else b)
    raise Unsupported("a derivative that is no sum over lanes")


def _contains_total(graph: Graph, node: int) -> bool:
    return any(graph.nodes[k][0] == "total" for k in graph.needed([node]))
