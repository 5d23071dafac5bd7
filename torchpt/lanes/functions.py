"""Elementary functions over vectors, without branches and without calls: argument reduction and a polynomial.

The polynomials are those of Moshier's Cephes library (*Methods and Programs for Mathematical Functions*, 1989) unless
something else is said. ``tests/lanes/test_functions.py`` states the error of each in units of the last place.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from torchpt.lanes.block import WIDTH, Block

__all__ = ["FUNCTIONS"]

_LN2 = math.log(2.0)
#: pi / 2 in parts of 33 bits, so that their products with up to 20 bits are exact.
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)


def _wide(b: Block, ty: str, x: str) -> str:
    return b.convert("fpext", "f", "d", x) if ty == "f" else x


def _narrow(b: Block, ty: str, x: str) -> str:
    return b.convert("fptrunc", "d", "f", x) if ty == "f" else x


def _absolute(b: Block, ty: str, x: str) -> str:
    return b.call("llvm.fabs", ty, x)


def _quadrant(b: Block, ty: str, x: str) -> tuple[str, str]:
    """The multiple of pi / 2 next to ``x`` modulo 4 (int32), and what is left."""
    y = _wide(b, ty, x)
    q = b.call("llvm.rint", "d", b.mul("d", y, b.constant("d", 2.0 / math.pi)))
    for part in _HALF_PI[: 2 if ty == "f" else 3]:
        y = b.fma("d", q, b.constant("d", -part), y)
    # Modulo 4 before it becomes an integer, so that no argument is too large for that.
    turns = b.call("llvm.floor", "d", b.mul("d", q, b.constant("d", 0.25)))
    q = b.fma("d", turns, b.constant("d", -4.0), q)
    finite = b.compare("olt", "d", _absolute(b, "d", q), b.constant("d", 5.0))
    q = b.select("d", finite, q, b.constant("d", 0.0))
    # Beyond 2^20 digits are lost, and far beyond any angle will do: one no larger than rounding leaves it.
    y = _clamped(b, "d", y, -0.79, 0.79)
    return b.convert("fptosi", "d", "i", q), _narrow(b, ty, y)


def _sine(b: Block, ty: str, x: str) -> str:
    """On [-pi / 4, pi / 4]."""
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
    """On [-pi / 4, pi / 4]."""
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


def _turned(b: Block, ty: str, q: str, s: str, c: str) -> str:
    """Sine or cosine of the quadrant ``q``, from both of the rest."""
    one, zero = b.constant("i", 1), b.constant("i", 0)
    odd = b.compare("ne", "i", b.binary("and", "i", q, one), zero)
    value = b.select(ty, odd, c, s)
    below = b.compare("ne", "i", b.binary("and", "i", q, b.constant("i", 2)), zero)
    return b.select(ty, below, b.negative(ty, value), value)


def _trigonometric(shift: int) -> Callable[[Block, str, str], str]:
    def function(b: Block, ty: str, x: str) -> str:
        q, rest = _quadrant(b, ty, x)
        if shift:
            q = b.add("i", q, b.constant("i", shift))
        found = _turned(b, ty, q, _sine(b, ty, rest), _cosine(b, ty, rest))
        if not shift:  # its zeros keep their sign
            found = b.select(ty, b.compare("oeq", ty, x, b.constant(ty, 0.0)), x, found)
        # Of infinity and of NaN there is none.
        none = b.compare("uge", ty, _absolute(b, ty, x), b.constant(ty, math.inf))
        return b.select(ty, none, b.constant(ty, math.nan), found)

    return function


def _tan(b: Block, ty: str, x: str) -> str:
    return b.div(ty, _trigonometric(0)(b, ty, x), _trigonometric(1)(b, ty, x))


def _scaled(b: Block, ty: str, p: str, q: str) -> str:
    """``p 2^q`` for a whole number ``q`` in floating point, by two factors so that neither overflows before it must."""
    n = b.convert("fptosi", ty, "i", q)
    half = b.binary("ashr", "i", n, b.constant("i", 1))
    for k in (half, b.sub("i", n, half)):
        if ty == "f":
            bits = b.binary("shl", "i", b.add("i", k, b.constant("i", 127)), b.constant("i", 23))
            p = b.mul(ty, p, b.convert("bitcast", "i", "f", bits))
        else:
            wide = b.convert("sext", "i", "L", k)
            bits = b.binary("shl", "L", b.add("L", wide, b.constant("L", 1023)), b.constant("L", 52))
            p = b.mul(ty, p, b.convert("bitcast", "L", "d", bits))
    return p


def _clamped(b: Block, ty: str, x: str, low: float, high: float) -> str:
    """Within limits beyond which the result is 0 or infinite; NaN stays."""
    return b.extreme("max", ty, b.extreme("min", ty, x, b.constant(ty, high)), b.constant(ty, low))


def _power_of_two(b: Block, ty: str, q: str, r: str) -> str:
    """``2^q e^r`` for whole ``q`` and ``|r| <= ln 2 / 2``; not for NaN."""
    if ty == "f":
        p = b.polynomial(
            ty,
            r,
            (1.9875691500e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1),
        )
        p = b.fma(ty, b.mul(ty, r, r), p, b.add(ty, r, b.constant(ty, 1.0)))
    else:  # Taylor's series: the remainder is below 1e-17
        p = b.polynomial(ty, r, tuple(1.0 / math.factorial(k) for k in range(13, -1, -1)))
    return _scaled(b, ty, p, q)


def _finish_exponential(b: Block, ty: str, x: str, found: str) -> str:
    return b.select(ty, b.compare("uno", ty, x, x), x, found)


def _exp(b: Block, ty: str, x: str, rest: str | None = None) -> str:
    """``e^x``, or ``e^(x + rest)`` for a rest below the last place of ``x``."""
    q, r = _reduced(b, ty, x, *((-104.0, 89.0) if ty == "f" else (-746.0, 710.0)))
    if rest is not None:
        r = b.add(ty, r, rest)
    return _finish_exponential(b, ty, x, _power_of_two(b, ty, q, r))


def _reduced(b: Block, ty: str, x: str, low: float, high: float) -> tuple[str, str]:
    """Whole ``q`` and ``r`` for ``x = q ln 2 + r`` within limits; 0 for NaN."""
    y = _clamped(b, ty, x, low, high)
    y = b.select(ty, b.compare("uno", ty, x, x), b.constant(ty, 0.0), y)
    q = b.call("llvm.rint", ty, b.mul(ty, y, b.constant(ty, 1.0 / _LN2)))
    for part in (0.693359375, -2.12194440e-4) if ty == "f" else (6.93145751953125e-1, 1.42860682030941723212e-6):
        y = b.fma(ty, q, b.constant(ty, -part), y)
    return q, y


def _exp2(b: Block, ty: str, x: str) -> str:
    low, high = (-151.0, 129.0) if ty == "f" else (-1076.0, 1025.0)
    y = _clamped(b, ty, x, low, high)
    y = b.select(ty, b.compare("uno", ty, x, x), b.constant(ty, 0.0), y)
    q = b.call("llvm.rint", ty, y)
    r = b.mul(ty, b.sub(ty, y, q), b.constant(ty, _LN2))
    return _finish_exponential(b, ty, x, _power_of_two(b, ty, q, r))


def _expm1(b: Block, ty: str, x: str) -> str:
    if ty == "f":
        found = _narrow(b, ty, b.sub("d", _exp(b, "d", _wide(b, ty, x)), b.constant("d", 1.0)))
        small = b.compare("olt", ty, _absolute(b, ty, x), b.constant(ty, 1e-8))
        return b.select(ty, small, x, found)
    # 2^q (e^r - 1 + (1 - 2^-q)), where the inner sum is exact.
    q, r = _reduced(b, ty, x, -40.0, 710.0)
    one = b.constant(ty, 1.0)
    p = b.polynomial(ty, r, tuple(1.0 / math.factorial(k) for k in range(13, 1, -1)))
    p = b.fma(ty, b.mul(ty, r, r), p, r)
    less = b.sub(ty, one, _scaled(b, ty, one, b.negative(ty, q)))
    found = _scaled(b, ty, b.add(ty, p, less), q)
    small = b.compare("olt", ty, _absolute(b, ty, x), b.constant(ty, 1e-17))  # and its zeros keep their sign
    return _finish_exponential(b, ty, x, b.select(ty, small, x, found))


def _log(b: Block, ty: str, x: str) -> str:
    if ty == "f":
        return _log_ends(b, ty, x, _narrow(b, ty, _log_series(b, _wide(b, ty, x), 5)))
    return _log_ends(b, ty, x, b.add(ty, *_log_parts(b, x)))


def _log_wide(b: Block, x: str) -> str:
    """The logarithm of a float64 that need be good to 50 bits only; denormals are not meant."""
    return _log_ends(b, "d", x, _log_series(b, x, 11))


def _log_ends(b: Block, ty: str, x: str, found: str) -> str:
    """Put in the logarithms of what is not positive and finite."""
    zero, inf = b.constant(ty, 0.0), b.constant(ty, math.inf)
    found = b.select(ty, b.compare("oeq", ty, x, zero), b.constant(ty, -math.inf), found)
    found = b.select(ty, b.compare("ult", ty, x, zero), b.constant(ty, math.nan), found)
    return b.select(ty, b.compare("oeq", ty, x, inf), inf, found)


def _mantissa(b: Block, y: str) -> tuple[str, str]:
    """A positive float64 as ``m 2^e``: ``m`` between the square roots of 1/2 and 2, and ``e`` as a float64."""
    bits = b.convert("bitcast", "d", "L", y)
    e = b.binary("ashr", "L", b.sub("L", bits, b.constant("L", 0x3FE6A09E00000000)), b.constant("L", 52))
    m = b.convert("bitcast", "L", "d", b.sub("L", bits, b.binary("shl", "L", e, b.constant("L", 52))))
    return m, b.convert("sitofp", "i", "d", b.convert("trunc", "L", "i", e))


#: ln 2 in two parts, the first of 32 bits.
_LN2_PARTS = 6.93147180369123816490e-01, 1.90821492927058770002e-10


def _log_series(b: Block, x: str, terms: int) -> str:
    """``ln m = 2 atanh(s)``, ``s = (m - 1) / (m + 1)``, ``|s| < 0.172``: the series."""
    m, e = _mantissa(b, x)
    f = b.sub("d", m, b.constant("d", 1.0))
    s = b.div("d", f, b.add("d", m, b.constant("d", 1.0)))
    z = b.mul("d", s, s)
    p = b.polynomial("d", z, tuple(2.0 / k for k in range(2 * terms + 1, 2, -2)))
    r = b.fma("d", b.mul("d", z, p), s, b.mul("d", s, b.constant("d", 2.0)))
    r = b.fma("d", e, b.constant("d", _LN2_PARTS[1]), r)
    return b.fma("d", e, b.constant("d", _LN2_PARTS[0]), r)


# Sums and products of float64 with what rounding took from them (Dekker 1971). No flag allows to contract them.


def _plain(b: Block, op: str, x: str, y: str) -> str:
    return b.op(f"{op} {b.vector('d')} {x}, {y}")


def _once(b: Block, x: str, y: str, z: str) -> str:
    """``x y + z`` rounded once on every machine."""
    return b.call("llvm.fma", "d", x, y, z)


def _two_sum(b: Block, x: str, y: str) -> tuple[str, str]:
    """Where ``x`` is the larger, or 0."""
    s = _plain(b, "fadd", x, y)
    return s, _plain(b, "fsub", y, _plain(b, "fsub", s, x))


def _two_product(b: Block, x: str, y: str) -> tuple[str, str]:
    p = _plain(b, "fmul", x, y)
    return p, _once(b, x, y, b.negative("d", p))


def _double_product(b: Block, x: tuple[str, str], y: tuple[str, str]) -> tuple[str, str]:
    p, rest = _two_product(b, x[0], y[0])
    rest = _once(b, x[0], y[1], _once(b, x[1], y[0], rest))
    return _two_sum(b, p, rest)


def _log_parts(b: Block, x: str) -> tuple[str, str]:
    """The logarithm of positive finite float64 as a sum of two, good to about 63 bits: the series of :func:`_log_series`."""
    tiny = b.compare("olt", "d", x, b.constant("d", 2.0**-1022))
    m, e = _mantissa(b, b.select("d", tiny, b.mul("d", x, b.constant("d", 2.0**54)), x))
    e = b.select("d", tiny, b.sub("d", e, b.constant("d", 54.0)), e)
    one = b.constant("d", 1.0)
    f = _plain(b, "fsub", m, one)
    # s = f / (2 + f), with the rest of the division.
    d = _two_sum(b, b.constant("d", 2.0), f)
    sh = b.div("d", f, d[0])
    off = _once(b, b.negative("d", sh), d[1], _once(b, b.negative("d", sh), d[0], f))
    s = sh, b.div("d", off, d[0])
    z = _double_product(b, s, s)
    # 2 + z (2/3 + z (2/5 + ...)): the last bracket needs no more than float64 has.
    p = b.polynomial("d", z[0], tuple(2.0 / k for k in range(23, 4, -2)))
    w = _two_sum(b, b.constant("d", 2.0 / 3.0), _plain(b, "fmul", z[0], p))
    w = w[0], b.add("d", w[1], b.constant("d", 3.700743415417188e-17))  # what 2/3 lacks
    w = _double_product(b, z, w)
    h = _two_sum(b, b.constant("d", 2.0), w[0])
    r = _double_product(b, s, (h[0], b.add("d", h[1], w[1])))
    t = _two_sum(b, _plain(b, "fmul", e, b.constant("d", _LN2_PARTS[0])), r[0])
    rest = _once(b, e, b.constant("d", _LN2_PARTS[1]), b.add("d", t[1], r[1]))
    return _two_sum(b, t[0], rest)


def _log_by(factor: float, rest: float) -> Callable[[Block, str, str], str]:
    """Logarithms times ``factor + rest``."""

    def function(b: Block, ty: str, x: str) -> str:
        if ty == "f":
            return _narrow(b, ty, b.mul("d", _log_wide(b, _wide(b, ty, x)), b.constant("d", factor)))
        parts = _double_product(b, _log_parts(b, x), (b.constant("d", factor), b.constant("d", rest)))
        return _log_ends(b, ty, x, b.add(ty, *parts))

    return function


def _log1p(b: Block, ty: str, x: str) -> str:
    small = b.compare("olt", ty, _absolute(b, ty, x), b.constant(ty, 1e-8 if ty == "f" else 1e-17))
    one = b.constant("d", 1.0)
    if ty == "f":
        found = _narrow(b, ty, _log_wide(b, b.add("d", _wide(b, ty, x), one)))
        return b.select(ty, small, x, found)
    # The logarithm of the rounded sum u, and what rounding took: ln(u + c) = ln u + c / u.
    u = _plain(b, "fadd", x, one)
    less = _plain(b, "fsub", u, x)
    c = _plain(b, "fadd", _plain(b, "fsub", x, _plain(b, "fsub", u, less)), _plain(b, "fsub", one, less))
    high, low = _log_parts(b, u)
    found = b.add(ty, high, b.add(ty, low, b.div(ty, c, u)))
    return b.select(ty, small, x, _log_ends(b, ty, u, found))


def _pow(b: Block, ty: str, x: str, y: str) -> str:
    """``e^(y ln |x|)`` in double, of float64 with the logarithm in two parts; whole powers of negatives have their sign."""
    p, q = _wide(b, ty, x), _wide(b, ty, y)
    size, zero, one, inf = _absolute(b, "d", p), *(b.constant("d", v) for v in (0.0, 1.0, math.inf))
    if ty == "f":
        found = _exp(b, "d", b.mul("d", q, _log_wide(b, size)))
    else:
        high, low = _log_parts(b, size)
        high = _log_ends(b, "d", size, high)
        product = _plain(b, "fmul", q, high)
        rest = _once(b, q, low, _once(b, q, high, b.negative("d", product)))
        ends = b.compare("ult", "d", _absolute(b, "d", product), b.constant("d", 800.0))  # else 0 or infinite
        found = _exp(b, "d", product, b.select("d", ends, rest, zero))
    whole = b.compare("oeq", "d", b.call("llvm.rint", "d", q), q)
    half = b.mul("d", q, b.constant("d", 0.5))
    odd = b.op(f"and <{WIDTH} x i1> {whole}, " + b.compare("one", "d", b.call("llvm.rint", "d", half), half))
    mirrored = b.select("d", odd, b.negative("d", found), found)
    # There is no broken power of a negative number; of -0 and of minus infinity it is that of the number without sign.
    some = b.op(f"and <{WIDTH} x i1> {b.compare('olt', 'd', p, zero)}, {b.compare('olt', 'd', size, inf)}")
    broken = b.compare("one", "d", b.call("llvm.rint", "d", q), q)
    missing = b.op(f"and <{WIDTH} x i1> {broken}, {some}")
    mirrored = b.select("d", missing, b.constant("d", math.nan), mirrored)
    found = b.select("d", _negative(b, "d", p), mirrored, found)
    endless = b.compare("oeq", "d", _absolute(b, "d", q), inf)
    always = b.op(f"and <{WIDTH} x i1> {endless}, {b.compare('oeq', 'd', size, one)}")  # (-1)^inf, as C has it
    for condition in (always, b.compare("oeq", "d", p, one), b.compare("oeq", "d", q, zero)):
        found = b.select("d", condition, one, found)
    return _narrow(b, ty, found)


def _atan_positive(b: Block, ty: str, x: str) -> str:
    """On [0, inf]."""
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
    found = b.fma(ty, p, r, r)
    start = b.select(ty, middle, b.constant(ty, math.pi / 4), b.constant(ty, 0.0))
    start = b.select(ty, steep, b.constant(ty, math.pi / 2), start)
    return b.add(ty, start, found)


def _atan(b: Block, ty: str, x: str) -> str:
    return b.call("llvm.copysign", ty, _atan_positive(b, ty, _absolute(b, ty, x)), x)


def _negative(b: Block, ty: str, x: str) -> str:
    """Whether the sign bit is set."""
    held = "i" if ty == "f" else "L"
    return b.compare("slt", held, b.convert("bitcast", ty, held, x), "zeroinitializer")


def _atan2(b: Block, ty: str, y: str, x: str) -> str:
    u, v = _absolute(b, ty, y), _absolute(b, ty, x)
    inf = b.constant(ty, math.inf)
    # Both infinite: as if both were 1. Both zero: as if the quotient were 0.
    both = b.op(f"and <{WIDTH} x i1> {b.compare('oeq', ty, u, inf)}, {b.compare('oeq', ty, v, inf)}")
    u, v = (b.select(ty, both, b.constant(ty, 1.0), w) for w in (u, v))
    none = b.compare("oeq", ty, b.extreme("max", ty, u, v), b.constant(ty, 0.0))
    v = b.select(ty, none, b.constant(ty, 1.0), v)
    r = _atan_positive(b, ty, b.div(ty, u, v))
    r = b.select(ty, _negative(b, ty, x), b.sub(ty, b.constant(ty, math.pi), r), r)
    return b.call("llvm.copysign", ty, r, y)


def _acos(b: Block, ty: str, x: str) -> str:
    return _atan2(b, ty, _other_leg(b, ty, x), x)


def _asin(b: Block, ty: str, x: str) -> str:
    return _atan2(b, ty, x, _other_leg(b, ty, x))


def _other_leg(b: Block, ty: str, x: str) -> str:
    """``sqrt(1 - x^2)``, NaN beyond 1."""
    one = b.constant(ty, 1.0)
    return b.call("llvm.sqrt", ty, b.mul(ty, b.sub(ty, one, x), b.add(ty, one, x)))


def _sigmoid(b: Block, ty: str, x: str) -> str:
    e = _exp(b, ty, b.negative(ty, _absolute(b, ty, x)))  # does not overflow
    one = b.constant(ty, 1.0)
    top = b.select(ty, b.compare("olt", ty, x, b.constant(ty, 0.0)), e, one)
    return b.div(ty, top, b.add(ty, one, e))


def _tanh(b: Block, ty: str, x: str) -> str:
    twice = b.mul(ty, _absolute(b, ty, x), b.constant(ty, 2.0))
    twice = b.extreme("min", ty, twice, b.constant(ty, 80.0))  # 1 up to rounding
    e = _expm1(b, ty, twice)
    return b.call("llvm.copysign", ty, b.div(ty, e, b.add(ty, e, b.constant(ty, 2.0))), x)


def _sinh(b: Block, ty: str, x: str) -> str:
    """``(e + e / (e + 1)) / 2`` with ``e = expm1(|x|)``, half of the exponent at a time so that it does not overflow early."""
    size = _absolute(b, ty, x)
    e = _expm1(b, ty, size)
    half, one = b.constant(ty, 0.5), b.constant(ty, 1.0)
    found = b.mul(ty, half, b.add(ty, e, b.div(ty, e, b.add(ty, e, one))))
    root = _exp(b, ty, b.mul(ty, half, size))
    large = b.mul(ty, b.mul(ty, half, root), root)
    found = b.select(ty, b.compare("ogt", ty, size, b.constant(ty, 20.0)), large, found)
    return b.call("llvm.copysign", ty, found, x)


def _cosh(b: Block, ty: str, x: str) -> str:
    half = b.constant(ty, 0.5)
    root = _exp(b, ty, b.mul(ty, half, _absolute(b, ty, x)))
    large = b.mul(ty, b.mul(ty, half, root), root)
    return b.add(ty, large, b.div(ty, half, b.mul(ty, root, root)))


#: Functions of one or two vectors: ``function(block, type, *arguments)``.
FUNCTIONS: dict[str, Callable[..., str]] = {
    "sin": _trigonometric(0),
    "cos": _trigonometric(1),
    "tan": _tan,
    "asin": _asin,
    "acos": _acos,
    "atan": _atan,
    "atan2": _atan2,
    "exp": _exp,
    "exp2": _exp2,
    "expm1": _expm1,
    "log": _log,
    "log2": _log_by(1.4426950408889634, 2.0355273740931033e-17),
    "log10": _log_by(0.4342944819032518, 1.098319650216765e-17),
    "log1p": _log1p,
    "pow": _pow,
    "sinh": _sinh,
    "cosh": _cosh,
    "tanh": _tanh,
    "sigmoid": _sigmoid,
}
