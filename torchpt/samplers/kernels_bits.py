"""Integer arithmetic that the samplers' kernels share; the tensor forms are in ``hashing.py`` and ``scrambling.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.jit import jit

__all__ = [
    "FURTHER",
    "SCALE",
    "SECOND",
    "U",
    "W",
    "X",
    "Y",
    "Z",
    "fourth_dimension",
    "mix",
    "reverse",
    "scramble",
    "second_dimension",
    "third_dimension",
    "unit",
]

U = np.uint32
_M0, _M1 = U(0x7FEB352D), U(0x846CA68B)
_K0, _K1, _K2 = U(0x3D20ADEA), U(0x05526C56), U(0x53A22864)
X, Y, Z, W, SECOND = U(0x68BC21EB), U(0x02E5BE93), U(0x967A889B), U(0x368CC8B7), U(0x9E3779B9)
#: What a kernel is asked for, beside one or two numbers: the two that a set of two goes on with.
FURTHER = 4
SCALE = np.float32(1.0 / (1 << 24))


@jit(inline="always")
def mix(x: Any) -> Any:
    """As ``hashing.mix``."""
    x = U(U(x ^ (x >> U(16))) * _M0)
    x = U(U(x ^ (x >> U(15))) * _M1)
    return U(x ^ (x >> U(16)))


@jit(inline="always")
def reverse(x: Any) -> Any:
    """As ``scrambling.reverse_bits``."""
    x = U(((x >> U(1)) & U(0x55555555)) | ((x & U(0x55555555)) << U(1)))
    x = U(((x >> U(2)) & U(0x33333333)) | ((x & U(0x33333333)) << U(2)))
    x = U(((x >> U(4)) & U(0x0F0F0F0F)) | ((x & U(0x0F0F0F0F)) << U(4)))
    x = U(((x >> U(8)) & U(0x00FF00FF)) | ((x & U(0x00FF00FF)) << U(8)))
    return U((x >> U(16)) | (x << U(16)))


@jit(inline="always")
def scramble(x: Any, seed: Any) -> Any:
    """As ``scrambling.scramble``."""
    x = U(x ^ U(x * _K0))
    x = U(x + seed)
    x = U(x * U((seed >> U(16)) | U(1)))
    x = U(x ^ U(x * _K1))
    return U(x ^ U(x * _K2))


@jit(inline="always")
def second_dimension(x: Any) -> Any:
    """As ``scrambling.second_dimension``."""
    x = U(x ^ ((x >> U(16)) & U(0x0000FFFF)))
    x = U(x ^ ((x >> U(8)) & U(0x00FF00FF)))
    x = U(x ^ ((x >> U(4)) & U(0x0F0F0F0F)))
    x = U(x ^ ((x >> U(2)) & U(0x33333333)))
    return U(x ^ ((x >> U(1)) & U(0x55555555)))


@jit(inline="always")
def _shifted(x: Any) -> Any:
    x = U(x ^ ((x >> U(16)) & U(0x0000FFFF)))
    x = U(x ^ ((x >> U(8)) & U(0x00FF00FF)))
    x = U(x ^ ((x >> U(4)) & U(0x0F0F0F0F)))
    return U(x ^ ((x >> U(2)) & U(0x33333333)))


@jit(inline="always")
def _turned(x: Any, once: Any, twice: Any) -> Any:
    low, high = U(x & U(0x55555555)), U((x >> U(1)) & U(0x55555555))
    both = U(low ^ high)
    return U((x & U(0xC30C30C3)) | (high & once) | (both & twice) | U(((both & once) | (low & twice)) << U(1)))


@jit(inline="always")
def third_dimension(x: Any) -> Any:
    """As ``scrambling.third_dimension``."""
    x = _turned(x, U(0x04104104), U(0x10410410))
    return _turned(_shifted(x), U(0x10410410), U(0x04104104))


@jit(inline="always")
def fourth_dimension(x: Any) -> Any:
    """As ``scrambling.fourth_dimension``."""
    x = _turned(x, U(0x10410410), U(0x04104104))
    x = _turned(_shifted(x), U(0x04104104), U(0x10410410))
    return U(x ^ ((x >> U(1)) & U(0x55555555)))


@jit(inline="always")
def unit(x: Any) -> Any:
    """As ``hashing.to_unit``."""
    return np.float32(np.int32(x >> U(8))) * SCALE
