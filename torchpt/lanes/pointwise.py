"""How operators that act on each number by itself are lowered, and reductions over other axes than the lanes'."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.lanes.graph import DTYPES, FLOATS, Unsupported
from torchpt.lanes.tracing import Tracer, handles

__all__: list[str] = []

Nodes = Callable[..., int]


def _apply(tracer: Tracer, out: Tensor, function: Nodes, *operands: Any) -> None:
    """``out`` is ``function`` of the operands' nodes, which are broadcast; operands that are numbers become constants."""
    graph = tracer.graph
    columns = [tracer.get(x).nodes if isinstance(x, Tensor) else np.array(_number(graph, x), object) for x in operands]
    shape = np.broadcast_shapes(*(c.shape for c in columns))
    columns = [np.broadcast_to(c, shape) for c in columns]
    result = np.empty(shape, object)
    for at in np.ndindex(*shape):
        result[at] = function(*(c[at] for c in columns))
    tracer.put(out, result)


def _number(graph: Any, x: float | int | bool) -> int:
    if isinstance(x, bool):
        return graph.constant("b", x)
    return graph.constant("l", x) if isinstance(x, int) else graph.constant("d", x)


def _type(tracer: Tracer, dtype: torch.dtype, *nodes: int) -> str:
    """The type in which numbers of a dtype are computed from nodes."""
    ty = DTYPES[dtype]
    return "L" if ty == "l" and any(tracer.graph.type(node) in "iL" for node in nodes) else ty


#: Operations after which 32 bits may no longer hold what they held before.
_GROWS = ("mul", "shl")


def _binary(op: str) -> Any:
    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
        def function(x: int, y: int) -> int:
            ty = _type(tracer, out.dtype, x, y)
            if ty == "l" and op in _GROWS:
                ty = "L"
            return tracer.graph.binary(op, ty, tracer.graph.cast(x, ty), tracer.graph.cast(y, ty))

        _apply(tracer, out, function, a, b)

    return handler


for _names, _op in (
    (("bitwise_and", "logical_and", "__and__"), "and"),
    (("bitwise_or", "logical_or", "__or__"), "or"),
    (("bitwise_xor", "logical_xor", "__xor__"), "xor"),
    (("__rshift__", "bitwise_right_shift"), "ashr"),
    (("__lshift__", "bitwise_left_shift"), "shl"),
    (("maximum", "clamp_min"), "max"),
    (("minimum", "clamp_max"), "min"),
    (("fmod",), "fmod"),
    (("remainder",), "remainder"),
    (("floor_divide",), "floordiv"),
    (("atan2",), "atan2"),
    (("copysign",), "copysign"),
):
    handles(*_names)(_binary(_op))


@handles("mul")
def _mul(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
    _binary("and" if out.dtype == torch.bool else "mul")(tracer, out, a, b)


@handles("div", "true_divide")
def _div(tracer: Tracer, out: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> None:
    if rounding_mode not in (None, "floor", "trunc"):
        raise Unsupported(f"division with rounding mode {rounding_mode}")
    _binary({None: "div", "floor": "floordiv", "trunc": "truncdiv"}[rounding_mode])(tracer, out, a, b)


def _sum(op: str) -> Any:
    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any, alpha: float = 1) -> None:
        graph = tracer.graph

        def function(x: int, y: int) -> int:
            ty = _type(tracer, out.dtype, x, y)
            x, y = graph.cast(x, ty), graph.cast(y, ty)
            if alpha != 1:
                y = graph.binary("mul", ty, y, graph.constant(ty, alpha))
            return graph.binary("or" if ty == "b" else op, ty, x, y)

        _apply(tracer, out, function, a, b)

    return handler


handles("add")(_sum("add"))
handles("sub")(_sum("sub"))


@handles("rsub")
def _rsub(tracer: Tracer, out: Tensor, a: Any, b: Any, alpha: float = 1) -> None:
    if alpha != 1:
        raise Unsupported("rsub with alpha")
    _sum("sub")(tracer, out, b, a)


@handles("addcmul")
def _addcmul(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor, c: Tensor, value: float = 1) -> None:
    graph, ty = tracer.graph, "L" if out.dtype == torch.int64 else DTYPES[out.dtype]

    def function(x: int, y: int, z: int) -> int:
        x, y, z = (graph.cast(w, ty) for w in (x, y, z))
        product = graph.binary("mul", ty, y, z)
        if value == -1:
            return graph.binary("sub", ty, x, product)
        if value != 1:
            product = graph.binary("mul", ty, product, graph.constant(ty, value))
        return graph.binary("add", ty, x, product)

    _apply(tracer, out, function, a, b, c)


@handles("lerp")
def _lerp(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor, weight: Any) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(x: int, y: int, w: int) -> int:
        x, y, w = (graph.cast(v, ty) for v in (x, y, w))
        # As torch has it: from the end that is nearer, so that both ends are met.
        length, one = graph.binary("sub", ty, y, x), graph.constant(ty, 1.0)
        low = graph.binary("add", ty, x, graph.binary("mul", ty, w, length))
        high = graph.binary("sub", ty, y, graph.binary("mul", ty, length, graph.binary("sub", ty, one, w)))
        near = graph.node("lt", "b", graph.node("abs", ty, w), graph.constant(ty, 0.5))
        return graph.select(near, low, high)

    _apply(tracer, out, function, a, b, weight)


def _unary(op: str) -> Any:
    def handler(tracer: Tracer, out: Tensor, a: Tensor) -> None:
        def function(x: int) -> int:
            ty = _type(tracer, out.dtype, x)
            return tracer.graph.node(op, ty, tracer.graph.cast(x, ty))

        _apply(tracer, out, function, a)

    return handler


for _name in (
    "sqrt abs neg sign floor ceil round trunc exp exp2 expm1 log log2 log10 log1p "
    "sin cos tan asin acos atan sinh cosh tanh sigmoid"
).split():
    handles(_name)(_unary(_name))


@handles("reciprocal")
def _reciprocal(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    _binary("div")(tracer, out, 1.0, a)


@handles("rsqrt")
def _rsqrt(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]
    _apply(
        tracer,
        out,
        lambda x: graph.node("div", ty, graph.constant(ty, 1.0), graph.node("sqrt", ty, graph.cast(x, ty))),
        a,
    )


@handles("square")
def _square(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    _binary("mul")(tracer, out, a, a)


@handles("relu")
def _relu(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    _binary("max")(tracer, out, a, 0)


@handles("softplus")
def _softplus(tracer: Tracer, out: Tensor, a: Tensor, beta: float = 1, threshold: float = 20) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(x: int) -> int:
        scaled = graph.binary("mul", ty, x, graph.constant(ty, beta))
        soft = graph.node("log1p", ty, graph.node("exp", ty, scaled))
        soft = graph.binary("div", ty, soft, graph.constant(ty, beta))
        return graph.select(graph.node("gt", "b", scaled, graph.constant(ty, threshold)), x, soft)

    _apply(tracer, out, function, a)


@handles("pow")
def _pow(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
    graph, ty = tracer.graph, "L" if out.dtype == torch.int64 else DTYPES[out.dtype]

    def power(x: int, n: int) -> int:
        half = power(x, n // 2) if n > 1 else x
        if n == 1:
            return x
        square = graph.binary("mul", ty, half, half)
        return graph.binary("mul", ty, square, x) if n % 2 else square

    def function(x: int, y: int) -> int:
        x, y = graph.cast(x, ty), graph.cast(y, ty)
        n = graph.value(y)
        if n == 0:
            return graph.constant(ty, 1)
        if n == 0.5:
            return graph.node("sqrt", ty, x)
        if n is not None and float(n).is_integer() and 1 <= n <= 8:
            return power(x, int(n))
        if n == -1:
            return graph.node("div", ty, graph.constant(ty, 1.0), x)
        if ty not in FLOATS:
            raise Unsupported("a power of integers")
        return graph.node("pow", ty, x, y)

    _apply(tracer, out, function, a, b)


@handles("bitwise_not", "logical_not")
def _not(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph = tracer.graph

    def function(x: int) -> int:
        ty = _type(tracer, out.dtype, x)
        if ty == "b":
            return graph.node("xor", "b", graph.cast(x, "b"), graph.constant("b", True))
        return graph.node("xor", ty, x, graph.constant(ty, -1))

    _apply(tracer, out, function, a)


@handles("isinf")
def _isinf(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[a.dtype]
    if ty not in FLOATS:
        return tracer.put(out, np.array(graph.constant("b", False), object))
    _apply(tracer, out, lambda x: graph.node("eq", "b", graph.node("abs", ty, x), graph.constant(ty, math.inf)), a)


@handles("isnan")
def _isnan(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    _apply(tracer, out, lambda x: tracer.graph.node("ne", "b", x, x), a)


@handles("isfinite")
def _isfinite(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[a.dtype]
    _apply(tracer, out, lambda x: graph.node("lt", "b", graph.node("abs", ty, x), graph.constant(ty, math.inf)), a)


@handles("where")
def _where(tracer: Tracer, out: Tensor, condition: Tensor, a: Any, b: Any) -> None:
    graph = tracer.graph

    def function(c: int, x: int, y: int) -> int:
        ty = _type(tracer, out.dtype, x, y)
        return graph.select(graph.cast(c, "b"), graph.cast(x, ty), graph.cast(y, ty))

    _apply(tracer, out, function, condition, a, b)


@handles("masked_fill")
def _masked_fill(tracer: Tracer, out: Tensor, a: Tensor, mask: Tensor, value: Any) -> None:
    _where(tracer, out, mask, value, a)


def _compare(op: str) -> Any:
    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
        graph, dtype = tracer.graph, torch.result_type(a, b)

        def function(x: int, y: int) -> int:
            ty = _type(tracer, dtype, x, y)
            return graph.node(op, "b", graph.cast(x, ty), graph.cast(y, ty))

        _apply(tracer, out, function, a, b)

    return handler


for _name in ("gt", "lt", "ge", "le", "eq", "ne"):
    handles(_name)(_compare(_name))


@handles("clamp", "clip")
def _clamp(tracer: Tracer, out: Tensor, a: Tensor, low: Any = None, high: Any = None) -> None:
    def function(x: int, *ends: int) -> int:
        graph, rest = tracer.graph, list(ends)
        ty = _type(tracer, out.dtype, x)
        x = graph.cast(x, ty)
        for op, end in (("max", low), ("min", high)):
            if end is not None:
                x = graph.binary(op, ty, x, graph.cast(rest.pop(0), ty))
        return x

    _apply(tracer, out, function, a, *(end for end in (low, high) if end is not None))


@handles("_to_copy", "to")
def _to_copy(tracer: Tracer, out: Tensor, a: Tensor, *_: Any, **__: Any) -> None:
    def function(x: int) -> int:
        own, ty = tracer.graph.type(x), DTYPES[out.dtype]
        if ty == "l" and own in "iL":
            ty = "L"  # products of what was 32 bits may need all 64
        return tracer.graph.cast(x, ty)

    _apply(tracer, out, function, a)


def _like(value: float) -> Any:
    def handler(tracer: Tracer, out: Tensor, *_: Any, **__: Any) -> None:
        tracer.put(out, np.array(tracer.graph.constant(DTYPES[out.dtype], value), object))

    return handler


handles("ones_like", "new_ones")(_like(1))
handles("zeros_like", "new_zeros")(_like(0))


@handles("full_like", "new_full")
def _full_like(tracer: Tracer, out: Tensor, a: Tensor, *rest: Any, **_: Any) -> None:
    tracer.put(out, np.array(tracer.graph.constant(DTYPES[out.dtype], rest[-1]), object))


def _axes(axis: Any, rank: int) -> list[int]:
    if axis is None or axis in ((), []):
        return list(range(rank))
    return sorted(a % rank for a in ([axis] if isinstance(axis, int) else axis))


def _reduce(op: str, boolean: bool = False) -> Any:
    def handler(
        tracer: Tracer, out: Tensor, a: Tensor, axis: Any = None, keepdim: bool = False, dtype: Any = None
    ) -> None:
        value, graph = tracer.get(a), tracer.graph
        nodes = value.nodes
        for k in reversed(_axes(axis, nodes.ndim)):
            if k == value.lane:
                raise Unsupported("a reduction over lanes")
            parts: list[Any] = [np.take(nodes, j, k) for j in range(nodes.shape[k])]
            if not parts:
                shape = (*nodes.shape[:k], *nodes.shape[k + 1 :])
                parts = [np.full(shape, _nothing(graph, op, DTYPES[out.dtype]), object)]
            total = _cast_all(tracer, parts[0], "b" if boolean else _sums(op, out))
            for part in parts[1:]:
                joined: Any = np.empty(total.shape, object)
                for at in np.ndindex(*total.shape):
                    ty = "b" if boolean else _type(tracer, out.dtype, total[at], part[at])
                    joined[at] = graph.binary(op, ty, graph.cast(total[at], ty), graph.cast(part[at], ty))
                total = joined
            nodes = np.expand_dims(total, k) if keepdim else total
        tracer.put(out, _cast_all(tracer, nodes, DTYPES[out.dtype]))

    return handler


def _sums(op: str, out: Tensor) -> str:
    """The type in which a reduction is computed."""
    return "L" if out.dtype == torch.int64 and op in ("add", "mul") else DTYPES[out.dtype]


def _nothing(graph: Any, op: str, ty: str) -> int:
    """What a reduction of no numbers gives."""
    if op not in ("add", "mul", "and", "or"):
        raise Unsupported("the largest or smallest of no numbers")
    return graph.constant(ty, 1 if op in ("mul", "and") else 0)


def _cast_all(tracer: Tracer, nodes: Any, ty: str) -> Any:
    found = np.empty(nodes.shape, object)
    for at in np.ndindex(*nodes.shape):
        node = nodes[at]
        found[at] = node if ty == "l" and tracer.graph.type(node) == "L" else tracer.graph.cast(node, ty)
    return found


handles("amax")(_reduce("max"))
handles("amin")(_reduce("min"))
handles("sum")(_reduce("add"))
handles("prod")(_reduce("mul"))
handles("all")(_reduce("and", boolean=True))
handles("any")(_reduce("or", boolean=True))


@handles("mean")
def _mean(tracer: Tracer, out: Tensor, a: Tensor, axis: Any = None, keepdim: bool = False, dtype: Any = None) -> None:
    _reduce("add")(tracer, out, a, axis, keepdim)
    count = math.prod(a.shape[k] for k in _axes(axis, a.dim()))
    _binary("div")(tracer, out, out, count)


@handles("cumsum")
def _cumsum(tracer: Tracer, out: Tensor, a: Tensor, axis: int, dtype: Any = None) -> None:
    value, graph, ty = tracer.get(a), tracer.graph, _sums("add", out)
    axis %= a.dim()
    if axis == value.lane:
        raise Unsupported("a sum over lanes")
    nodes = np.moveaxis(_cast_all(tracer, value.nodes, ty), axis, 0).copy()
    for k in range(1, len(nodes)):
        for at in np.ndindex(*nodes.shape[1:]):
            nodes[(k, *at)] = graph.binary("add", ty, nodes[(k - 1, *at)], nodes[(k, *at)])
    tracer.put(out, np.moveaxis(nodes, 0, axis))
