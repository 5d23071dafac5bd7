"""Sines, cosines, tangents and their inverses."""

from __future__ import annotations

import math
from collections.abc import Callable

from torchpt.compiler.block import Block
from torchpt.compiler.functions.values import absolute, clamped, narrow, negative, wide

__all__ = ["acos", "asin", "atan", "atan2", "tan", "trigonometric"]

#: pi / 2 in parts of 33 bits, so that their products with up to 20 bits are exact.
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)


def _quadrant(b: Block, ty: str, x: str) -> tuple[str, str]:
    """Return the number of the multiple of pi / 2 nearest to ``x``, modulo 4 (int32), and ``x`` minus that multiple."""
    y = wide(b, ty, x)
    q = b.call("llvm.rint", "d", b.mul("d", y, b.constant("d", 2.0 / math.pi)))
    for part in _HALF_PI[: 2 if ty == "f" else 3]:
        y = b.fma("d", q, b.constant("d", -part), y)
    # Modulo 4 in floating point, as the quotient of a large argument overflows an integer.
    turns = b.call("llvm.floor", "d", b.mul("d", q, b.constant("d", 0.25)))
    q = b.fma("d", turns, b.constant("d", -4.0), q)
    finite = b.compare("olt", "d", absolute(b, "d", q), b.constant("d", 5.0))
    q = b.select("d", finite, q, b.constant("d", 0.0))
    # Beyond 2^20 the remainder loses digits; far beyond, it may be anything and is clamped, to a bit more than pi / 4.
    y = clamped(b, "d", y, -0.79, 0.79)
    return b.convert("fptosi", "d", "i", q), narrow(b, ty, y)


def _sine(b: Block, ty: str, x: str) -> str:
    """Compute the sine on [-pi / 4, pi / 4]."""
    z = b.mul(ty, x, x)
    if ty == "f":
        p = b.polynomial(ty, z, (-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1))
    else:
        p = b.polynomial(
            ty,
            z,
            (
                1.58962301576546568060e-10, -2.50507477628578072866e-8, 2.75573136213857245213e-6,
                -1.98412698295895385996e-4, 8.33333333332211858878e-3, -1.66666666666666307295e-1,
            ),
        )  # fmt: skip
    return b.fma(ty, b.mul(ty, p, z), x, x)


def _cosine(b: Block, ty: str, x: str) -> str:
    """Compute the cosine on [-pi / 4, pi / 4]."""
    z = b.mul(ty, x, x)
    if ty == "f":
        p = b.polynomial(ty, z, (2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2))
    else:
        p = b.polynomial(
            ty,
            z,
            (
                -1.13585365213876817300e-11, 2.08757008419747316778e-9, -2.75573141792967388112e-7,
                2.48015872888517045348e-5, -1.38888888888730564116e-3, 4.16666666666665929218e-2,
            ),
        )  # fmt: skip
    return b.fma(ty, b.mul(ty, z, z), p, b.fma(ty, z, b.constant(ty, -0.5), b.constant(ty, 1.0)))


def _sine_in_quadrant(b: Block, ty: str, q: str, sine: str, cosine: str) -> str:
    """Return the sine of an angle from its quadrant ``q`` and sine and cosine of the remainder."""
    one, zero = b.constant("i", 1), b.constant("i", 0)
    odd = b.compare("ne", "i", b.binary("and", "i", q, one), zero)
    value = b.select(ty, odd, cosine, sine)
    third_or_fourth = b.compare("ne", "i", b.binary("and", "i", q, b.constant("i", 2)), zero)
    return b.select(ty, third_or_fourth, b.negative(ty, value), value)


def trigonometric(shift: int) -> Callable[[Block, str, str], str]:
    """Return the function for the sine; for the cosine if ``shift`` is 1, a quarter of a turn."""

    def function(b: Block, ty: str, x: str) -> str:
        q, remainder = _quadrant(b, ty, x)
        if shift:
            q = b.add("i", q, b.constant("i", shift))
        value = _sine_in_quadrant(b, ty, q, _sine(b, ty, remainder), _cosine(b, ty, remainder))
        if not shift:  # keeps the sign of zeros
            value = b.select(ty, b.compare("oeq", ty, x, b.constant(ty, 0.0)), x, value)
        not_finite = b.compare("uge", ty, absolute(b, ty, x), b.constant(ty, math.inf))
        return b.select(ty, not_finite, b.constant(ty, math.nan), value)

    return function


def tan(b: Block, ty: str, x: str) -> str:
    """Compute the tangent."""
    return b.div(ty, trigonometric(shift=0)(b, ty, x), trigonometric(shift=1)(b, ty, x))


def _atan_positive(b: Block, ty: str, x: str) -> str:
    """Compute the inverse tangent on [0, inf].

    Around 1 it is ``pi / 4 + atan((x - 1) / (x + 1))``, above ``pi / 2 + atan(-1 / x)``.
    """
    one = b.constant(ty, 1.0)
    steep = b.compare("ogt", ty, x, b.constant(ty, 1.0 + math.sqrt(2.0)))
    middle = b.compare("ogt", ty, x, b.constant(ty, math.sqrt(2.0) - 1.0 if ty == "f" else 0.66))
    top = b.select(ty, middle, b.sub(ty, x, one), x)
    bottom = b.select(ty, middle, b.add(ty, x, one), one)
    top = b.select(ty, steep, b.constant(ty, -1.0), top)
    bottom = b.select(ty, steep, x, bottom)
    r = b.div(ty, top, bottom)
    z = b.mul(ty, r, r)
    if ty == "f":
        p = b.polynomial(ty, z, (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1))
        p = b.mul(ty, p, z)
    else:
        p = b.polynomial(
            ty,
            z,
            (
                -8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1,
                -1.228866684490136173410e2, -6.485021904942025371773e1,
            ),
        )  # fmt: skip
        q = b.polynomial(
            ty,
            z,
            (
                1.0, 2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2,
                4.853903996359136964868e2, 1.945506571482613964425e2,
            ),
        )  # fmt: skip
        p = b.div(ty, b.mul(ty, z, p), q)
    angle = b.fma(ty, p, r, r)
    start = b.select(ty, middle, b.constant(ty, math.pi / 4), b.constant(ty, 0.0))
    start = b.select(ty, steep, b.constant(ty, math.pi / 2), start)
    return b.add(ty, start, angle)


def atan(b: Block, ty: str, x: str) -> str:
    """Compute the inverse tangent."""
    return b.call("llvm.copysign", ty, _atan_positive(b, ty, absolute(b, ty, x)), x)


def atan2(b: Block, ty: str, y: str, x: str) -> str:
    """Compute the angle of ``(x, y)``, with zeros and infinities as in C."""
    u, v = absolute(b, ty, y), absolute(b, ty, x)
    inf = b.constant(ty, math.inf)
    # Both infinite: as if both were 1. Both zero: as if the quotient were 0.
    both_infinite = b.op(f"and {b.each('i1')} {b.compare('oeq', ty, u, inf)}, {b.compare('oeq', ty, v, inf)}")
    u, v = (b.select(ty, both_infinite, b.constant(ty, 1.0), w) for w in (u, v))
    both_zero = b.compare("oeq", ty, b.extreme("max", ty, u, v), b.constant(ty, 0.0))
    v = b.select(ty, both_zero, b.constant(ty, 1.0), v)
    r = _atan_positive(b, ty, b.div(ty, u, v))
    r = b.select(ty, negative(b, ty, x), b.sub(ty, b.constant(ty, math.pi), r), r)
    return b.call("llvm.copysign", ty, r, y)


def acos(b: Block, ty: str, x: str) -> str:
    """Compute the inverse cosine."""
    return atan2(b, ty, _other_leg(b, ty, x), x)


def asin(b: Block, ty: str, x: str) -> str:
    """Compute the inverse sine."""
    return atan2(b, ty, x, _other_leg(b, ty, x))


def _other_leg(b: Block, ty: str, x: str) -> str:
    """Compute ``sqrt(1 - x^2)``; NaN for ``|x| > 1``."""
    one = b.constant(ty, 1.0)
    return b.call("llvm.sqrt", ty, b.mul(ty, b.sub(ty, one, x), b.add(ty, one, x)))
