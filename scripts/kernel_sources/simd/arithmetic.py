"""Operators of vectors, lane by lane, and the selection between two vectors."""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import lower_builtin, type_callable

from kernel_sources.simd.types import I32, Vector, intrinsic

__all__ = ["absolute", "as_float", "as_int", "maximum", "minimum", "narrow", "select", "square_root", "widen"]


def _is_float(kind: Any) -> bool:
    return isinstance(getattr(kind, "element", kind), types.Float)


def _binary(symbol: Any, for_floats: str | None, for_others: str | None) -> None:
    """Define an operator of vectors, by the names of its LLVM instructions for floats and for other elements."""

    def typed(a, b):
        if isinstance(a, Vector) and a == b and (for_floats if _is_float(a) else for_others):
            return a
        return None

    type_callable(symbol)(lambda context: typed)

    @lower_builtin(symbol, Vector, Vector)
    def _(context, builder, signature, args):
        return getattr(builder, str(for_floats if _is_float(signature.args[0]) else for_others))(*args)


def _compare(symbol: Any, code: str) -> None:
    """Define a comparison of vectors, whose result is a mask; ``code`` is llvmlite's name of it."""

    def typed(a, b):
        return Vector(types.boolean, a.lanes) if isinstance(a, Vector) and a == b else None

    type_callable(symbol)(lambda context: typed)

    @lower_builtin(symbol, Vector, Vector)
    def _(context, builder, signature, args):
        if not _is_float(signature.args[0]):
            return builder.icmp_signed(code, *args)
        # comparisons with NaN are False, except !=
        return (builder.fcmp_unordered if code == "!=" else builder.fcmp_ordered)(code, *args)


def _unary(symbol: Any, generate: Any, allowed: Any) -> None:
    """Define an operator of one vector, of the types for which ``allowed`` is True."""

    def typed(a):
        return a if isinstance(a, Vector) and allowed(a) else None

    type_callable(symbol)(lambda context: typed)
    lower_builtin(symbol, Vector)(lambda context, builder, signature, args: generate(builder, args[0]))


_binary(operator.add, "fadd", "add")
_binary(operator.sub, "fsub", "sub")
_binary(operator.mul, "fmul", "mul")
_binary(operator.truediv, "fdiv", None)
_binary(operator.and_, None, "and_")
_binary(operator.or_, None, "or_")
_binary(operator.xor, None, "xor")
for _symbol, _code in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _compare(_symbol, _code)
_unary(operator.neg, lambda builder, x: builder.fneg(x), _is_float)
_unary(operator.invert, lambda builder, x: builder.not_(x), lambda kind: not _is_float(kind))


@intrinsic
def select(context, m, a, b):
    """Select lanes of ``a`` where the mask is set, else of ``b``: ``select(m, a, b)``."""
    if not (isinstance(a, Vector) and a == b and m == Vector(types.boolean, a.lanes)):
        return None
    return a(m, a, b), lambda context, builder, signature, args: builder.select(*args)


def _chosen(builder: Any, code: str, kind: Any, a: Any, b: Any) -> Any:
    """Select lanes of ``a`` where the comparison ``code`` of ``a`` with ``b`` holds, else of ``b``."""
    met = builder.fcmp_ordered(code, a, b) if _is_float(kind) else builder.icmp_signed(code, a, b)
    return builder.select(met, a, b)


@intrinsic
def minimum(context, a, b):
    """Return the smaller lanes; ``b`` if either is NaN or both are equal (as 0 and -0 are)."""
    if not (isinstance(a, Vector) and a == b):
        return None
    return a(a, b), lambda context, builder, signature, args: _chosen(builder, "<", signature.args[0], *args)


@intrinsic
def maximum(context, a, b):
    """Return the larger lanes; ``b`` if either is NaN or both are equal (as 0 and -0 are)."""
    if not (isinstance(a, Vector) and a == b):
        return None
    return a(a, b), lambda context, builder, signature, args: _chosen(builder, ">", signature.args[0], *args)


@intrinsic
def as_int(context, x):
    """Reinterpret the bits of float32, of a vector or a scalar, as int32."""
    if x == types.float32:
        return types.int32(x), lambda context, builder, signature, args: builder.bitcast(args[0], I32)
    if not (isinstance(x, Vector) and x.element == types.float32):
        return None
    kind = ir.VectorType(I32, x.lanes)
    return Vector(types.int32, x.lanes)(x), lambda context, builder, signature, args: builder.bitcast(args[0], kind)


@intrinsic
def as_float(context, x):
    """Reinterpret int32 lanes, or the low 32 bits of an integer, as float32."""
    if isinstance(x, types.Integer):  # arithmetic of int32 scalars is int64 in numba
        return types.float32(types.int32), lambda context, builder, signature, args: builder.bitcast(
            args[0], ir.FloatType()
        )
    if not (isinstance(x, Vector) and x.element == types.int32):
        return None
    kind = ir.VectorType(ir.FloatType(), x.lanes)
    return Vector(types.float32, x.lanes)(x), lambda context, builder, signature, args: builder.bitcast(args[0], kind)


@intrinsic
def absolute(context, x):
    """Clear the sign bit of float lanes."""
    if not (isinstance(x, Vector) and _is_float(x)):
        return None
    return x(x), lambda context, builder, signature, args: _of_floats(builder, "fabs", x, args[0])


@intrinsic
def square_root(context, x):
    """Compute the square root of float lanes; NaN for negative ones."""
    if not (isinstance(x, Vector) and _is_float(x)):
        return None
    return x(x), lambda context, builder, signature, args: _of_floats(builder, "sqrt", x, args[0])


def _of_floats(builder: Any, name: str, kind: Vector, x: Any) -> Any:
    """Call LLVM's intrinsic ``name`` on float lanes."""
    shape = ir.FunctionType(x.type, [x.type])
    return builder.call(cgutils.get_or_insert_function(builder.module, shape, f"llvm.{name}.{kind.code}"), [x])


@intrinsic
def widen(context, x):
    """Convert float32 lanes to float64."""
    if not (isinstance(x, Vector) and x.element == types.float32):
        return None
    kind = ir.VectorType(ir.DoubleType(), x.lanes)
    return Vector(types.float64, x.lanes)(x), lambda context, builder, signature, args: builder.fpext(args[0], kind)


@intrinsic
def narrow(context, x):
    """Round float64 lanes to float32."""
    if not (isinstance(x, Vector) and x.element == types.float64):
        return None
    kind = ir.VectorType(ir.FloatType(), x.lanes)
    return Vector(types.float32, x.lanes)(x), lambda context, builder, signature, args: builder.fptrunc(args[0], kind)
