"""Lowerings of arithmetic and elementary functions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchpt.compiler.graph import DTYPES, FLOATS, Unsupported
from torchpt.compiler.operators.nodes import apply, type_of
from torchpt.compiler.tracing import Tracer, register_lowering

__all__ = ["binary"]


#: Operations whose result may need more than 32 bits where the operands did not.
_GROWS = ("mul", "shl")
#: Largest constant exponent of a power that is computed by at most four multiplications instead of logarithm and exponential.
_MOST_MULTIPLIED = 8


def binary(op: str) -> Any:
    """Return the lowering of an elementwise operator of two operands to the node ``op``."""

    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
        def function(x: int, y: int) -> int:
            ty = type_of(tracer, out.dtype, x, y)
            if ty == "l" and op in _GROWS:
                ty = "L"
            return tracer.graph.binary(op, ty, tracer.graph.cast(x, ty), tracer.graph.cast(y, ty))

        apply(tracer, out, function, a, b)

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
    register_lowering(*_names)(binary(_op))


@register_lowering("mul")
def _mul(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
    binary("and" if out.dtype == torch.bool else "mul")(tracer, out, a, b)


@register_lowering("div", "true_divide")
def _div(tracer: Tracer, out: Tensor, a: Any, b: Any, rounding_mode: str | None = None) -> None:
    if rounding_mode not in (None, "floor", "trunc"):
        raise Unsupported(f"division with rounding mode {rounding_mode}")
    binary({None: "div", "floor": "floordiv", "trunc": "truncdiv"}[rounding_mode])(tracer, out, a, b)


def _sum(op: str) -> Any:
    """Return the lowering of ``a + alpha b`` (``add``) or ``a - alpha b`` (``sub``)."""

    def handler(tracer: Tracer, out: Tensor, a: Any, b: Any, alpha: float = 1) -> None:
        graph = tracer.graph

        def function(x: int, y: int) -> int:
            ty = type_of(tracer, out.dtype, x, y)
            x, y = graph.cast(x, ty), graph.cast(y, ty)
            if alpha != 1:
                y = graph.binary("mul", ty, y, graph.constant(ty, alpha))
            return graph.binary("or" if ty == "b" else op, ty, x, y)

        apply(tracer, out, function, a, b)

    return handler


register_lowering("add")(_sum("add"))
register_lowering("sub")(_sum("sub"))


@register_lowering("rsub")
def _rsub(tracer: Tracer, out: Tensor, a: Any, b: Any, alpha: float = 1) -> None:
    if alpha != 1:
        raise Unsupported("rsub with alpha")
    _sum("sub")(tracer, out, b, a)


@register_lowering("addcmul")
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

    apply(tracer, out, function, a, b, c)


@register_lowering("lerp")
def _lerp(tracer: Tracer, out: Tensor, a: Tensor, b: Tensor, weight: Any) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(x: int, y: int, w: int) -> int:
        x, y, w = (graph.cast(v, ty) for v in (x, y, w))
        # As in torch: from the nearer end, so that both ends are exact.
        length, one = graph.binary("sub", ty, y, x), graph.constant(ty, 1.0)
        low = graph.binary("add", ty, x, graph.binary("mul", ty, w, length))
        high = graph.binary("sub", ty, y, graph.binary("mul", ty, length, graph.binary("sub", ty, one, w)))
        near = graph.node("lt", "b", graph.node("abs", ty, w), graph.constant(ty, 0.5))
        return graph.select(near, low, high)

    apply(tracer, out, function, a, b, weight)


def _unary(op: str) -> Any:
    """Return the lowering of an elementwise operator of one operand to the node ``op``."""

    def handler(tracer: Tracer, out: Tensor, a: Tensor) -> None:
        def function(x: int) -> int:
            ty = type_of(tracer, out.dtype, x)
            return tracer.graph.node(op, ty, tracer.graph.cast(x, ty))

        apply(tracer, out, function, a)

    return handler


for _name in (
    "sqrt abs neg sign floor ceil round trunc exp exp2 expm1 log log2 log10 log1p "
    "sin cos tan asin acos atan sinh cosh tanh sigmoid"
).split():
    register_lowering(_name)(_unary(_name))


@register_lowering("reciprocal")
def _reciprocal(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    binary("div")(tracer, out, 1.0, a)


@register_lowering("rsqrt")
def _rsqrt(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]
    apply(
        tracer,
        out,
        lambda x: graph.node("div", ty, graph.constant(ty, 1.0), graph.node("sqrt", ty, graph.cast(x, ty))),
        a,
    )


@register_lowering("square")
def _square(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    binary("mul")(tracer, out, a, a)


@register_lowering("relu")
def _relu(tracer: Tracer, out: Tensor, a: Tensor) -> None:
    binary("max")(tracer, out, a, 0)


@register_lowering("softplus")
def _softplus(tracer: Tracer, out: Tensor, a: Tensor, beta: float = 1, threshold: float = 20) -> None:
    graph, ty = tracer.graph, DTYPES[out.dtype]

    def function(x: int) -> int:
        scaled = graph.binary("mul", ty, x, graph.constant(ty, beta))
        soft = graph.node("log1p", ty, graph.node("exp", ty, scaled))
        soft = graph.binary("div", ty, soft, graph.constant(ty, beta))
        return graph.select(graph.node("gt", "b", scaled, graph.constant(ty, threshold)), x, soft)

    apply(tracer, out, function, a)


@register_lowering("pow")
def _pow(tracer: Tracer, out: Tensor, a: Any, b: Any) -> None:
    graph, ty = tracer.graph, "L" if out.dtype == torch.int64 else DTYPES[out.dtype]

    def power(x: int, n: int) -> int:
        """Multiply ``x`` with itself, by squaring."""
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
        if n is not None and float(n).is_integer() and 1 <= n <= _MOST_MULTIPLIED:
            return power(x, int(n))
        if n == -1:
            return graph.node("div", ty, graph.constant(ty, 1.0), x)
        if ty not in FLOATS:
            raise Unsupported("a power of integers")
        return graph.node("pow", ty, x, y)

    apply(tracer, out, function, a, b)
