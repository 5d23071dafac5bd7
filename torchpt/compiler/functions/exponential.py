"""Exponentials to base e and 2, hyperbolic functions and the sigmoid."""

from __future__ import annotations

import math

from torchpt.compiler.block import Block
from torchpt.compiler.functions.values import absolute, clamped, narrow, wide

__all__ = ["cosh", "exp", "exp2", "expm1", "sigmoid", "sinh", "tanh"]

_LN2 = math.log(2.0)


def _scaled(b: Block, ty: str, p: str, q: str) -> str:
    """Compute ``p 2^q`` for an integer ``q`` held as a float.

    It is multiplied by two powers of two, made of their bits, since ``2^q`` alone may overflow where the product does not.
    """
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


def _power_of_two(b: Block, ty: str, q: str, r: str) -> str:
    """Compute ``2^q e^r`` for integer ``q`` and ``|r| <= ln 2 / 2``; not for NaN."""
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


def _finish_exponential(b: Block, ty: str, x: str, value: str) -> str:
    """Return ``value``, or NaN where ``x`` is NaN."""
    return b.select(ty, b.compare("uno", ty, x, x), x, value)


def exp(b: Block, ty: str, x: str, rest: str | None = None) -> str:
    """Compute ``e^x``, or ``e^(x + rest)`` for a rest below one ulp of ``x``."""
    # beyond these limits the result is 0 or infinite
    q, r = _reduced(b, ty, x, *((-104.0, 89.0) if ty == "f" else (-746.0, 710.0)))
    if rest is not None:
        r = b.add(ty, r, rest)
    return _finish_exponential(b, ty, x, _power_of_two(b, ty, q, r))


def _reduced(b: Block, ty: str, x: str, low: float, high: float) -> tuple[str, str]:
    """Reduce ``x``, clamped to limits, to integer ``q`` and ``r`` with ``x = q ln 2 + r``; NaN gives 0."""
    y = clamped(b, ty, x, low, high)
    y = b.select(ty, b.compare("uno", ty, x, x), b.constant(ty, 0.0), y)
    q = b.call("llvm.rint", ty, b.mul(ty, y, b.constant(ty, 1.0 / _LN2)))
    for part in (0.693359375, -2.12194440e-4) if ty == "f" else (6.93145751953125e-1, 1.42860682030941723212e-6):
        y = b.fma(ty, q, b.constant(ty, -part), y)
    return q, y


def exp2(b: Block, ty: str, x: str) -> str:
    """Compute ``2^x``."""
    low, high = (-151.0, 129.0) if ty == "f" else (-1076.0, 1025.0)  # beyond, the result is 0 or infinite
    y = clamped(b, ty, x, low, high)
    y = b.select(ty, b.compare("uno", ty, x, x), b.constant(ty, 0.0), y)
    q = b.call("llvm.rint", ty, y)
    r = b.mul(ty, b.sub(ty, y, q), b.constant(ty, _LN2))
    return _finish_exponential(b, ty, x, _power_of_two(b, ty, q, r))


def expm1(b: Block, ty: str, x: str) -> str:
    """Compute ``e^x - 1``."""
    if ty == "f":
        value = narrow(b, ty, b.sub("d", exp(b, "d", wide(b, ty, x)), b.constant("d", 1.0)))
        small = b.compare("olt", ty, absolute(b, ty, x), b.constant(ty, 1e-8))
        return b.select(ty, small, x, value)
    # 2^q (e^r - 1 + (1 - 2^-q)), where the inner sum is exact. Below -40 the result is -1.
    q, r = _reduced(b, ty, x, low=-40.0, high=710.0)
    one = b.constant(ty, 1.0)
    p = b.polynomial(ty, r, tuple(1.0 / math.factorial(k) for k in range(13, 1, -1)))
    p = b.fma(ty, b.mul(ty, r, r), p, r)
    inner = b.sub(ty, one, _scaled(b, ty, one, b.negative(ty, q)))
    value = _scaled(b, ty, b.add(ty, p, inner), q)
    small = b.compare("olt", ty, absolute(b, ty, x), b.constant(ty, 1e-17))  # keeps the sign of zeros, too
    return _finish_exponential(b, ty, x, b.select(ty, small, x, value))


def sigmoid(b: Block, ty: str, x: str) -> str:
    """Compute the sigmoid ``1 / (1 + e^-x)``."""
    e = exp(b, ty, b.negative(ty, absolute(b, ty, x)))  # does not overflow
    one = b.constant(ty, 1.0)
    top = b.select(ty, b.compare("olt", ty, x, b.constant(ty, 0.0)), e, one)
    return b.div(ty, top, b.add(ty, one, e))


def tanh(b: Block, ty: str, x: str) -> str:
    """Compute the hyperbolic tangent, by ``expm1(2 |x|)``."""
    twice = b.mul(ty, absolute(b, ty, x), b.constant(ty, 2.0))
    twice = b.extreme("min", ty, twice, b.constant(ty, 80.0))  # beyond, the result is 1 up to rounding
    e = expm1(b, ty, twice)
    return b.call("llvm.copysign", ty, b.div(ty, e, b.add(ty, e, b.constant(ty, 2.0))), x)


def sinh(b: Block, ty: str, x: str) -> str:
    """Compute the hyperbolic sine: ``(e + e / (e + 1)) / 2`` with ``e = expm1(|x|)``; if large, ``exp(|x| / 2)`` squared."""
    size = absolute(b, ty, x)
    e = expm1(b, ty, size)
    half, one = b.constant(ty, 0.5), b.constant(ty, 1.0)
    value = b.mul(ty, half, b.add(ty, e, b.div(ty, e, b.add(ty, e, one))))
    root = exp(b, ty, b.mul(ty, half, size))
    large = b.mul(ty, b.mul(ty, half, root), root)
    # from 20 on e^-|x| is below the rounding error of e^|x|
    value = b.select(ty, b.compare("ogt", ty, size, b.constant(ty, 20.0)), large, value)
    return b.call("llvm.copysign", ty, value, x)


def cosh(b: Block, ty: str, x: str) -> str:
    """Compute the hyperbolic cosine, by ``exp(|x| / 2)`` squared, which avoids early overflow."""
    half = b.constant(ty, 0.5)
    root = exp(b, ty, b.mul(ty, half, absolute(b, ty, x)))
    large = b.mul(ty, b.mul(ty, half, root), root)
    return b.add(ty, large, b.div(ty, half, b.mul(ty, root, root)))
