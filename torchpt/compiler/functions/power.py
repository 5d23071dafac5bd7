"""Powers of any base and exponent."""

from __future__ import annotations

import math

from torchpt.compiler.block import Block
from torchpt.compiler.functions.exponential import exp
from torchpt.compiler.functions.logarithm import log_ends, log_parts, log_wide
from torchpt.compiler.functions.values import absolute, narrow, negative, wide

__all__ = ["power"]


def power(b: Block, ty: str, x: str, y: str) -> str:
    """Compute ``x^y`` as ``e^(y ln |x|)`` in float64, for float64 with a double-double logarithm."""
    p, q = wide(b, ty, x), wide(b, ty, y)
    size, zero, one, inf = absolute(b, "d", p), *(b.constant("d", v) for v in (0.0, 1.0, math.inf))
    if ty == "f":
        value = exp(b, "d", b.mul("d", q, log_wide(b, size)))
    else:
        high, low = log_parts(b, size)
        high = log_ends(b, "d", size, high)
        product = b.mul("d", q, high)
        product_error = b.fma("d", q, low, b.fma("d", q, high, b.negative("d", product)))
        # beyond 800 the result is 0 or infinite, and the error may be NaN
        in_range = b.compare("ult", "d", absolute(b, "d", product), b.constant("d", 800.0))
        value = exp(b, "d", product, b.select("d", in_range, product_error, zero))
    # so far of |x|; now of negative x
    is_integer = b.compare("oeq", "d", b.call("llvm.rint", "d", q), q)
    half = b.mul("d", q, b.constant("d", 0.5))
    is_odd = b.op(f"and {b.each('i1')} {is_integer}, " + b.compare("one", "d", b.call("llvm.rint", "d", half), half))
    of_negative = b.select("d", is_odd, b.negative("d", value), value)
    # A fractional power of a negative number is NaN; that of -0 and of minus infinity is the power of the absolute value.
    finite_negative = b.op(f"and {b.each('i1')} {b.compare('olt', 'd', p, zero)}, {b.compare('olt', 'd', size, inf)}")
    is_fractional = b.compare("one", "d", b.call("llvm.rint", "d", q), q)
    undefined = b.op(f"and {b.each('i1')} {is_fractional}, {finite_negative}")
    of_negative = b.select("d", undefined, b.constant("d", math.nan), of_negative)
    value = b.select("d", negative(b, "d", p), of_negative, value)
    # 1, as in C: (-1)^inf, 1^y for any y, x^0 for any x
    infinite_exponent = b.compare("oeq", "d", absolute(b, "d", q), inf)
    unit_to_infinity = b.op(f"and {b.each('i1')} {infinite_exponent}, {b.compare('oeq', 'd', size, one)}")
    for condition in (unit_to_infinity, b.compare("oeq", "d", p, one), b.compare("oeq", "d", q, zero)):
        value = b.select("d", condition, one, value)
    return narrow(b, ty, value)
