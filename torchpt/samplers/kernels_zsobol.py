"""Kernels of the ``zsobol`` sampler."""

from __future__ import annotations

from typing import Any

import numba as nb

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import U, X, Y, mix, reverse, scramble, second_dimension, unit
from torchpt.samplers.kinds.zsobol import DIGITS

__all__ = ["parallel", "serial"]


@jit(inline="always")
def _digits(word: Any, state: Any, index: Any, first: int, number: int) -> Any:
    for step in range(first, first + number):
        shift = U(2 * (DIGITS - step) - 1)
        digit = U((word >> shift) & U(3))
        one = U(U(1) + U(U((state >> U(16)) * U(3)) >> U(16)))
        other = U(U(U(1) + one) - U(U(3) * U((one + U(1)) >> U(2))))
        other = U(other ^ U(one & U(U(0) - U((state >> U(4)) & U(1)))))
        moved = U(one & U(U(0) - U(digit & U(1)))) ^ U(other & U(U(0) - U(digit >> U(1)))) ^ U((state >> U(2)) & U(3))
        index = U(index | U(U(moved) << shift))
        state = mix(U(state + U(digit + U(1))))
    return state, index


@jit(inline="always")
def _curve(word: Any, state: Any) -> Any:
    # In parts that the compiler unrolls: a loop within the loop over lanes would keep that from being vector code.
    state, index = _digits(word, state, U(0), 0, 4)
    state, index = _digits(word, state, index, 4, 4)
    state, index = _digits(word, state, index, 8, 4)
    odd = U(word >> U(31))
    return U(U(index | U(U(U(word ^ state) & U(1)) & odd)) >> U(U(1) - odd))


@jit()
def _zsobol_1d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        o0[i] = unit(reverse(scramble(_curve(k1[i], seed), mix(U(seed ^ X)))))


@jit()
def _zsobol_2d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = _curve(k1[i], seed)
        o0[i] = unit(reverse(scramble(index, mix(U(seed ^ X)))))
        o1[i] = unit(reverse(scramble(second_dimension(index), mix(U(seed ^ Y)))))


@jit(inline="always")
def _range(rows: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    if rows == 1:
        _zsobol_1d(k0, k1, salt, o0, o1)
    else:
        _zsobol_2d(k0, k1, salt, o0, o1)


@jit()
def serial(
    first: int, last: int, block: int, rows: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """See :mod:`torchpt.samplers.kernels`."""
    a, b = first * block, min(last * block, len(k0))
    _range(rows, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])


@jit(parallel=True)
def parallel(
    chunks: int, items: int, block: int, rows: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """See :mod:`torchpt.samplers.kernels`."""
    for chunk in nb.prange(chunks):
        a, b = items * chunk // chunks * block, min(items * (chunk + 1) // chunks * block, len(k0))
        _range(rows, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])
