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
    # Of arguments so large that their digits say nothing of the angle, any angle will do.
    y = _clamped(b, "d", y, -0.25 * math.pi, 0.25 * math.pi)
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


def _exp(b: Block, ty: str, x: str) -> str:
    low, high = (-104.0, 89.0) if ty == "f" else (-746.0, 710.0)
    y = _clamped(b, ty, x, low, high)
    y = b.select(ty, b.compare("uno", ty, x, x), b.constant(ty, 0.0), y)
    q = b.call("llvm.rint", ty, b.mul(ty, y, b.constant(ty, 1.0 / _LN2)))
    parts = (0.693359375, -2.12194440e-4) if ty == "f" else (6.93145751953125e-1, 1.42860682030941723212e-6)
    r = y
    for part in parts:
        r = b.fma(ty, q, b.constant(ty, -part), r)
    return _finish_exponential(b, ty, x, _power_of_two(b, ty, q, r))


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
    # Kahan's: the error of e^x is undone by that of its logarithm.
    u = _exp(b, ty, x)
    one = b.constant(ty, 1.0)
    less = b.sub(ty, u, one)
    middle = b.div(ty, b.mul(ty, less, x), _log(b, ty, u))
    middle = b.select(ty, b.compare("oeq", ty, u, one), x, middle)
    plain = b.compare("ogt", ty, _absolute(b, ty, x), one)
    return b.select(ty, plain, less, middle)


def _log(b: Block, ty: str, x: str) -> str:
    found = _log_normal(b, ty, x)
    zero, inf = b.constant(ty, 0.0), b.constant(ty, math.inf)
    found = b.select(ty, b.compare("oeq", ty, x, zero), b.constant(ty, -math.inf), found)
    found = b.select(ty, b.compare("ult", ty, x, zero), b.constant(ty, math.nan), found)
    return b.select(ty, b.compare("oeq", ty, x, inf), inf, found)


def _log_normal(b: Block, ty: str, x: str) -> str:
    """Of positive finite numbers: of float32 in double, of float64 with denormals scaled up."""
    y = _wide(b, ty, x)
    shift = None
    if ty == "d":
        tiny = b.compare("olt", "d", y, b.constant("d", 2.0**-1022))
        y = b.select("d", tiny, b.mul("d", y, b.constant("d", 2.0**54)), y)
        shift = b.select("d", tiny, b.constant("d", -54.0), b.constant("d", 0.0))
    # Mantissa between the square roots of 1/2 and 2.
    bits = b.convert("bitcast", "d", "L", y)
    e = b.binary("ashr", "L", b.sub("L", bits, b.constant("L", 0x3FE6A09E00000000)), b.constant("L", 52))
    m = b.convert("bitcast", "L", "d", b.sub("L", bits, b.binary("shl", "L", e, b.constant("L", 52))))
    e = b.convert("sitofp", "i", "d", b.convert("trunc", "L", "i", e))
    if shift is not None:
        e = b.add("d", e, shift)
    # ln m = 2 atanh(s), s = (m - 1) / (m + 1), |s| < 0.172: the series.
    f = b.sub("d", m, b.constant("d", 1.0))
    s = b.div("d", f, b.add("d", m, b.constant("d", 1.0)))
    z = b.mul("d", s, s)
    p = b.polynomial("d", z, tuple(2.0 / k for k in range(11 if ty == "f" else 23, 2, -2)))
    r = b.fma("d", b.mul("d", z, p), s, b.mul("d", s, b.constant("d", 2.0)))
    # ln 2 in two parts, the first of 32 bits.
    r = b.fma("d", e, b.constant("d", 1.90821492927058770002e-10), r)
    r = b.fma("d", e, b.constant("d", 6.93147180369123816490e-01), r)
    return _narrow(b, ty, r)


def _log_by(base: float) -> Callable[[Block, str, str], str]:
    def function(b: Block, ty: str, x: str) -> str:
        if ty == "f":
            wide = b.mul("d", _log(b, "d", _wide(b, ty, x)), b.constant("d", 1.0 / math.log(base)))
            return _narrow(b, ty, wide)
        return b.mul(ty, _log(b, ty, x), b.constant(ty, 1.0 / math.log(base)))

    return function


def _log1p(b: Block, ty: str, x: str) -> str:
    if ty == "f":
        found = _narrow(b, ty, _log(b, "d", b.add("d", _wide(b, ty, x), b.constant("d", 1.0))))
        small = b.compare("olt", ty, _absolute(b, ty, x), b.constant(ty, 1e-8))
        return b.select(ty, small, x, found)
    one = b.constant(ty, 1.0)
    u = b.add(ty, x, one)
    logarithm = _log(b, ty, u)
    found = b.div(ty, b.mul(ty, logarithm, x), b.sub(ty, u, one))
    found = b.select(ty, b.compare("oeq", ty, u, one), x, found)
    ends = b.compare("ueq", ty, _absolute(b, ty, logarithm), b.constant(ty, math.inf))
    return b.select(ty, ends, logarithm, found)


def _pow(b: Block, ty: str, x: str, y: str) -> str:
    """Of positive ``x`` ``e^(y ln x)`` in double; whole powers of negative numbers have their sign."""
    p, q = _wide(b, ty, x), _wide(b, ty, y)
    found = _exp(b, "d", b.mul("d", q, _log(b, "d", _absolute(b, "d", p))))
    zero, one = b.constant("d", 0.0), b.constant("d", 1.0)
    negative = b.compare("olt", "d", p, zero)
    whole = b.compare("oeq", "d", b.call("llvm.rint", "d", q), q)
    half = b.mul("d", q, b.constant("d", 0.5))
    odd = b.op(f"and <{WIDTH} x i1> {whole}, " + b.compare("one", "d", b.call("llvm.rint", "d", half), half))
    mirrored = b.select("d", odd, b.negative("d", found), found)
    missing = b.op(
        f"and <{WIDTH} x i1> {b.compare('one', 'd', b.call('llvm.rint', 'd', q), q)}, "
        + b.compare("ogt", "d", p, b.constant("d", -math.inf))
    )
    mirrored = b.select("d", missing, b.constant("d", math.nan), mirrored)
    found = b.select("d", negative, mirrored, found)
    found = b.select("d", b.compare("oeq", "d", p, one), one, found)
    found = b.select("d", b.compare("oeq", "d", q, zero), one, found)
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
    one = b.constant(ty, 1.0)
    return b.div(ty, one, b.add(ty, one, _exp(b, ty, b.negative(ty, x))))


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
    "log2": _log_by(2.0),
    "log10": _log_by(10.0),
    "log1p": _log1p,
    "pow": _pow,
    "sinh": _sinh,
    "cosh": _cosh,
    "tanh": _tanh,
    "sigmoid": _sigmoid,
}
