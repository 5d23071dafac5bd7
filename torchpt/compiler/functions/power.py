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
        rest = b.fma("d", q, low, b.fma("d", q, high, b.negative("d", product)))
        ends = b.compare(
            "ult", "d", absolute(b, "d", product), b.constant("d", 800.0)
        )  # beyond, the result is 0 or infinite
        value = exp(b, "d", product, b.select("d", ends, rest, zero))
    whole = b.compare("oeq", "d", b.call("llvm.rint", "d", q), q)
    half = b.mul("d", q, b.constant("d", 0.5))
    odd = b.op(f"and {b.each('i1')} {whole}, " + b.compare("one", "d", b.call("llvm.rint", "d", half), half))
    mirrored = b.select("d", odd, b.negative("d", value), value)
    # A fractional power of a negative number is NaN; that of -0 and of minus infinity is the power of the absolute value.
    some = b.op(f"and {b.each('i1')} {b.compare('olt', 'd', p, zero)}, {b.compare('olt', 'd', size, inf)}")
    broken = b.compare("one", "d", b.call("llvm.rint", "d", q), q)
    missing = b.op(f"and {b.each('i1')} {broken}, {some}")
    mirrored = b.select("d", missing, b.constant("d", math.nan), mirrored)
    value = b.select("d", negative(b, "d", p), mirrored, value)
    endless = b.compare("oeq", "d", absolute(b, "d", q), inf)
    always = b.op(f"and {b.each('i1')} {endless}, {b.compare('oeq', 'd', size, one)}")  # (-1)^inf, as C has it
    for condition in (always, b.compare("oeq", "d", p, one), b.compare("oeq", "d", q, zero)):
        value = b.select("d", condition, one, value)
    return narrow(b, ty, value)
