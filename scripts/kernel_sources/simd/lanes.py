"""Operations across lanes: masks as integers, minimum and maximum, sorting."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types

from kernel_sources.simd.types import I32, Vector, intrinsic, lanes_of, numbers

__all__ = ["bits", "highest", "lane_numbers", "lowest", "mask", "popcount", "sort_descending", "trailing_zeros"]

_I64 = ir.IntType(64)


@intrinsic
def bits(context, m):
    """Convert a mask to an int64, lane 0 in the lowest bit."""
    if not (isinstance(m, Vector) and m.element == types.boolean):
        return None

    def generate(context, builder, signature, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(m.lanes)), _I64)

    return types.int64(m), generate


@intrinsic(prefer_literal=True)
def mask(context, x, n):
    """Convert the lowest ``n`` bits of an int64 to a mask: ``mask(x, n)``."""
    lanes = lanes_of(n)

    def generate(context, builder, signature, args):
        return builder.bitcast(builder.trunc(args[0], ir.IntType(lanes)), ir.VectorType(ir.IntType(1), lanes))

    return Vector(types.boolean, lanes)(types.int64, n), generate


@intrinsic(prefer_literal=True)
def lane_numbers(context, n):
    """Return the int32 vector 0, 1, 2, ...: ``lane_numbers(n)``."""
    lanes = lanes_of(n)
    return Vector(types.int32, lanes)(n), lambda context, builder, signature, args: numbers(range(lanes))


@intrinsic
def trailing_zeros(context, x):
    """Return the index of the lowest set bit of an int64 that is not 0."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.cttz(args[0], ir.IntType(1)(1))


@intrinsic
def popcount(context, x):
    """Count the set bits of an int64."""
    return types.int64(types.int64), lambda context, builder, signature, args: builder.ctpop(args[0])


def _shuffled(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(a, b, numbers(order))


def _ordered(builder: Any, kind: Vector, code: str, a: Any, b: Any) -> Any:
    compare = builder.fcmp_ordered if isinstance(kind.element, types.Float) else builder.icmp_signed
    return builder.select(compare(code, a, b), a, b)


def _extreme(code: str) -> Any:
    """Return the generator of a minimum (``<``) or maximum (``>``) over lanes: halves of the vector are compared in turn."""

    def generate(context, builder, signature, args):
        kind, x = signature.args[0], args[0]
        step = kind.lanes // 2
        while step:
            x = _ordered(builder, kind, code, x, _shuffled(builder, x, x, [k ^ step for k in range(kind.lanes)]))
            step //= 2
        return builder.extract_element(x, I32(0))

    return generate


@intrinsic
def lowest(context, x):
    """Return the least lane of a vector without NaN."""
    if not isinstance(x, Vector) or x.element == types.boolean:
        return None
    return x.element(x), _extreme("<")


@intrinsic
def highest(context, x):
    """Return the greatest lane of a vector without NaN."""
    if not isinstance(x, Vector) or x.element == types.boolean:
        return None
    return x.element(x), _extreme(">")


def _network(lanes: int) -> list[list[int]]:
    """Return a sorting network: for each layer the lane with which each lane is compared (Batcher 1968, bitonic merging)."""
    layers, size = [], 2
    while size <= lanes:
        layers.append([k ^ (size - 1) for k in range(lanes)])
        step = size // 4
        while step:
            layers.append([k ^ step for k in range(lanes)])
            step //= 2
        size *= 2
    return layers


@intrinsic
def sort_descending(context, x):
    """Sort int32 lanes, the greatest first, without branches."""
    if not (isinstance(x, Vector) and x.element == types.int32):
        return None

    def generate(context, builder, signature, args):
        value, lanes = args[0], x.lanes
        for partner in _network(lanes):
            other = _shuffled(builder, value, value, partner)
            high, low = (_ordered(builder, x, code, value, other) for code in (">", "<"))
            # the lower lane of each pair keeps the greater number
            value = _shuffled(builder, high, low, [k if k < partner[k] else lanes + k for k in range(lanes)])
        return value

    return x(x), generate
