"""How operators of backward passes are lowered: what autograd calls beside the operators of the stages themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from torchpt.compiler.graph import DTYPES, Graph, Unsupported
from torchpt.compiler.operators.arithmetic import binary
from torchpt.compiler.operators.choices import masked_fill
from torchpt.compiler.operators.nodes import apply, cast_all
from torchpt.compiler.tracing import Tracer, register_lowering

__all__ = ["sum_over_lanes", "summand_of"]


def _zeros(tracer: Tracer, out: Tensor) -> tuple[Any, int | None]:
    lane = tracer.lane_axis(out.shape)
    return np.full(tracer.inner(out.shape, lane), tracer.graph.constant(DTYPES[out.dtype], 0), object), lane


@register_lowering("select_backward")
def _select_backward(tracer: Tracer, out: Tensor, given: Tensor, sizes: Any, axis: int, index: int) -> None:
    nodes, lane = _zeros(tracer, out)
    if axis % out.dim() == lane:
        raise Unsupported("one lane taken out")
    place: list[Any] = [slice(None)] * out.dim()
    place[axis] = index
    nodes[tuple(place)] = tracer.get(given).nodes
    tracer.put(out, nodes, lane)


@register_lowering("slice_backward")
def _slice_backward(
    tracer: Tracer, out: Tensor, given: Tensor, sizes: Any, axis: int, start: int, end: int, step: int
) -> None:
    nodes, lane = _zeros(tracer, out)
    if axis % out.dim() == lane:
        if out.shape != given.shape:
            raise Unsupported("a part of the lanes")
        return tracer.alias(out, given)
    place: list[Any] = [slice(None)] * out.dim()
    place[axis] = slice(start, None if end > 1 << 40 else end, step)
    nodes[tuple(place)] = tracer.get(given).nodes
    tracer.put(out, nodes, lane)


@register_lowering("logical_and_")
def _logical_and_(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor) -> None:
    """In place: what the derivative of a clamp makes of a comparison that nobody else reads."""
    binary("and")(tracer, out, a, b)
    if out is not a:
        tracer.alias(a, out)


@register_lowering("masked_fill_")
def _masked_fill_(tracer: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> None:
    """In place: what the derivative of a maximum makes of a number that nobody else reads."""
    masked_fill(tracer, out, a, mask, value)
    if out is not a:
        tracer.alias(a, out)


@register_lowering("sgn")
def _sgn(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    ty = DTYPES[out.dtype]
    apply(tracer, out, lambda x: tracer.graph.node("sign", ty, tracer.graph.cast(x, ty)), a)


@register_lowering("threshold_backward")
def _threshold_backward(tracer: Tracer, out: Tensor, given: Tensor, a: Tensor, threshold: float) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, x: int) -> int:
        below = graph.node("le", "b", graph.cast(x, ty), graph.constant(ty, threshold))
        return graph.select(below, graph.constant(ty, 0), graph.cast(g, ty))

    apply(tracer, out, function, given, a)


@register_lowering("tanh_backward")
def _tanh_backward(tracer: Tracer, out: Tensor, given: Tensor, y: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, t: int) -> int:
        rest = graph.binary("sub", ty, graph.constant(ty, 1), graph.binary("mul", ty, t, t))
        return graph.binary("mul", ty, g, rest)

    apply(tracer, out, function, given, y)


@register_lowering("sigmoid_backward")
def _sigmoid_backward(tracer: Tracer, out: Tensor, given: Tensor, y: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(g: int, s: int) -> int:
        rest = graph.binary("mul", ty, s, graph.binary("sub", ty, graph.constant(ty, 1), s))
        return graph.binary("mul", ty, g, rest)

    apply(tracer, out, function, given, y)


def sum_over_lanes(tracer: Tracer, nodes: Any, axis: int, ty: str) -> Any:
    """A sum over lanes: numbers that no lane knows, which kernels give away as rows of what they are sums of."""
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
    """The number of a lane whose sum over lanes the node is; None: 0.

    Raises:
        Unsupported: no sum over lanes.
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
    if op in ("mul", "div"):  # by what all lanes share
        whole = [_holds_total(graph, x) for x in arguments]
        if whole[0] and not whole[1]:
            a = summand_of(graph, arguments[0])
            return None if a is None else graph.binary(op, ty, a, arguments[1])
        if whole[1] and not whole[0] and op == "mul":
            a = summand_of(graph, arguments[1])
            return None if a is None else graph.binary(op, ty, arguments[0], a)
    if op == "select" and not _holds_total(graph, arguments[0]):
        a, b = (summand_of(graph, x) for x in arguments[1:])
        zero = graph.constant(ty, 0)
        return graph.select(arguments[0], zero if a is None else a, zero if b is None else b)
    raise Unsupported("a derivative that is no sum over lanes")


def _holds_total(graph: Graph, node: int) -> bool:
    return any(graph.nodes[k][0] == "total" for k in graph.needed([node]))
