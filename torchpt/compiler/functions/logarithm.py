"""Logarithms."""

from __future__ import annotations

import math
from collections.abc import Callable

from torchpt.compiler.block import Block
from torchpt.compiler.functions.double import double_product, two_sum
from torchpt.compiler.functions.values import absolute, narrow, wide

__all__ = ["log", "log1p", "log_by", "log_ends", "log_parts", "log_wide"]

#: ln 2 in two parts, the first of 32 bits.
_LN2_PARTS = 6.93147180369123816490e-01, 1.90821492927058770002e-10


def log(b: Block, ty: str, x: str) -> str:
    """Compute the natural logarithm."""
    if ty == "f":
        return log_ends(b, ty, x, narrow(b, ty, _log_series(b, wide(b, ty, x), terms=5)))
    return log_ends(b, ty, x, b.add(ty, *log_parts(b, x)))


def log_wide(b: Block, x: str) -> str:
    """Compute the logarithm of a float64 to about 50 bits; denormals are not supported."""
    return log_ends(b, "d", x, _log_series(b, x, terms=11))


def log_ends(b: Block, ty: str, x: str, value: str) -> str:
    """Replace ``value`` by the logarithms of 0, negative numbers and infinity where ``x`` is one of these."""
    zero, inf = b.constant(ty, 0.0), b.constant(ty, math.inf)
    value = b.select(ty, b.compare("oeq", ty, x, zero), b.constant(ty, -math.inf), value)
    value = b.select(ty, b.compare("ult", ty, x, zero), b.constant(ty, math.nan), value)
    return b.select(ty, b.compare("oeq", ty, x, inf), inf, value)


def _mantissa(b: Block, y: str) -> tuple[str, str]:
    """Split a positive float64 into ``m 2^e``: ``m`` between the square roots of 1/2 and 2, and ``e`` as a float64."""
    bits = b.convert("bitcast", "d", "L", y)
    # relative to the bits of the square root of 1/2, the exponent counts from there
    e = b.binary("ashr", "L", b.sub("L", bits, b.constant("L", 0x3FE6A09E00000000)), b.constant("L", 52))
    m = b.convert("bitcast", "L", "d", b.sub("L", bits, b.binary("shl", "L", e, b.constant("L", 52))))
    return m, b.convert("sitofp", "i", "d", b.convert("trunc", "L", "i", e))


def _log_series(b: Block, x: str, terms: int) -> str:
    """Compute the logarithm of ``x = m 2^e`` by the series of ``ln m = 2 atanh(s)``.

    Here ``s = (m - 1) / (m + 1)``, so ``|s| < 0.172``; ``terms`` is the number of terms after the first, ``2 s``.
    """
    m, e = _mantissa(b, x)
    f = b.sub("d", m, b.constant("d", 1.0))
    s = b.div("d", f, b.add("d", m, b.constant("d", 1.0)))
    z = b.mul("d", s, s)
    p = b.polynomial("d", z, tuple(2.0 / k for k in range(2 * terms + 1, 2, -2)))
    r = b.fma("d", b.mul("d", z, p), s, b.mul("d", s, b.constant("d", 2.0)))
    r = b.fma("d", e, b.constant("d", _LN2_PARTS[1]), r)
    return b.fma("d", e, b.constant("d", _LN2_PARTS[0]), r)


def log_parts(b: Block, x: str) -> tuple[str, str]:
    """Compute the logarithm of positive finite float64 as a sum of two, to about 63 bits; the series of :func:`_log_series`."""
    # denormals are scaled to normal numbers
    tiny = b.compare("olt", "d", x, b.constant("d", 2.0**-1022))
    m, e = _mantissa(b, b.select("d", tiny, b.mul("d", x, b.constant("d", 2.0**54)), x))
    e = b.select("d", tiny, b.sub("d", e, b.constant("d", 54.0)), e)
    one = b.constant("d", 1.0)
    f = b.sub("d", m, one)
    # From here on the numbers are double-double: high part, low part.
    # s = f / (2 + f)
    d_high, d_low = two_sum(b, b.constant("d", 2.0), f)
    s_high = b.div("d", f, d_high)
    off = b.fma("d", b.negative("d", s_high), d_low, b.fma("d", b.negative("d", s_high), d_high, f))
    s = s_high, b.div("d", off, d_high)
    z_high, z_low = double_product(b, s, s)
    # s (2 + z (2/3 + z (2/5 + ...))) with z = s^2: the last bracket needs no more than float64 has.
    p = b.polynomial("d", z_high, tuple(2.0 / k for k in range(23, 4, -2)))
    w_high, w_low = two_sum(b, b.constant("d", 2.0 / 3.0), b.mul("d", z_high, p))
    w_low = b.add("d", w_low, b.constant("d", 3.700743415417188e-17))  # rounding error of 2/3
    w_high, w_low = double_product(b, (z_high, z_low), (w_high, w_low))
    h_high, h_low = two_sum(b, b.constant("d", 2.0), w_high)
    r_high, r_low = double_product(b, s, (h_high, b.add("d", h_low, w_low)))
    t_high, t_low = two_sum(b, b.mul("d", e, b.constant("d", _LN2_PARTS[0])), r_high)
    rest = b.fma("d", e, b.constant("d", _LN2_PARTS[1]), b.add("d", t_low, r_low))
    return two_sum(b, t_high, rest)


def log_by(factor: float, rest: float) -> Callable[[Block, str, str], str]:
    """Return the function that multiplies the natural logarithm by ``factor + rest``."""

    def function(b: Block, ty: str, x: str) -> str:
        if ty == "f":
            return narrow(b, ty, b.mul("d", log_wide(b, wide(b, ty, x)), b.constant("d", factor)))
        parts = double_product(b, log_parts(b, x), (b.constant("d", factor), b.constant("d", rest)))
        return log_ends(b, ty, x, b.add(ty, *parts))

    return function


def log1p(b: Block, ty: str, x: str) -> str:
    """Compute ``ln(1 + x)``."""
    small = b.compare("olt", ty, absolute(b, ty, x), b.constant(ty, 1e-8 if ty == "f" else 1e-17))
    one = b.constant("d", 1.0)
    if ty == "f":
        value = narrow(b, ty, log_wide(b, b.add("d", wide(b, ty, x), one)))
        return b.select(ty, small, x, value)
    # With u the rounded sum 1 + x and c its rounding error: ln(u + c) = ln u + c / u.
    u = b.add("d", x, one)
    rounded_one = b.sub("d", u, x)  # 1 as it entered the sum
    c = b.add("d", b.sub("d", x, b.sub("d", u, rounded_one)), b.sub("d", one, rounded_one))
    high, low = log_parts(b, u)
    value = b.add(ty, high, b.add(ty, low, b.div(ty, c, u)))
    return b.select(ty, small, x, log_ends(b, ty, u, value))
