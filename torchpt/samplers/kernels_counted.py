"""Kernels of the samplers that know their number of points: apart, so that they are compiled only where they are used."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import SCALE, U, X, Y, mix, reverse, scramble, second_dimension, unit
from torchpt.samplers.shuffling import ROUNDS, STEP, STRIDE
from torchpt.samplers.zsobol import DIGITS

__all__ = ["BODIES", "parallel", "serial"]

_LEVELS = np.float64(1 << 24)
_STRIDE, _STEP = U(STRIDE), U(STEP & 0xFFFFFFFF)
#: The order in which :func:`_range` knows the kinds.
BODIES = ("stratified", "hammersley", "zsobol")


@jit(inline="always")
def _pivot(seed: Any, count: Any) -> Any:
    return U((np.uint64(seed >> U(1)) * np.uint64(count)) >> np.uint64(31))


@jit(inline="always")
def _shuffle(index: Any, count: Any, seed: Any) -> Any:
    pivot = _pivot(seed, count)
    index = U(U(index - pivot) + (count if pivot > index else U(0)))
    for _ in range(ROUNDS):
        seed = U(U(seed * _STRIDE) + _STEP)
        pivot = _pivot(seed, count)
        partner = U(U(pivot - index) + (count if index > pivot else U(0)))
        swap = U(np.int32(mix(U(max(index, partner) ^ seed))) >> np.int32(31))
        index = U(index ^ U(U(index ^ partner) & swap))
    return index


@jit(inline="always")
def _place(stratum: Any, jitter: Any, count: Any) -> Any:
    level = np.floor((stratum + jitter) / count * _LEVELS)
    return np.float32(np.int32(min(level, _LEVELS - 1.0))) * SCALE


@jit(inline="always")
def _real(x: Any) -> Any:
    return np.float64(np.int32(x))


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
def _strata_1d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        stratum = _shuffle(k1[i], k2[i], seed)
        jitter = np.float64(unit(mix(U(mix(U(seed ^ X)) ^ stratum))))
        o0[i] = _place(_real(stratum), jitter, _real(k2[i]))


@jit()
def _stratified_2d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        stratum = _shuffle(k1[i], k2[i], seed)
        x = np.float64(unit(mix(U(mix(U(seed ^ X)) ^ stratum))))
        y = np.float64(unit(mix(U(mix(U(seed ^ Y)) ^ stratum))))
        k, count = _real(stratum), _real(k2[i])
        columns = np.floor(np.sqrt(count) + 0.5)
        column = np.floor(((k + 1.0) * columns - 1.0) / count)
        first, end = np.floor(column * count / columns), np.floor((column + 1.0) * count / columns)
        rows = end - first
        o0[i] = _place(first, x * rows, count)
        o1[i] = _place(k - first, y, rows)


@jit()
def _hammersley_2d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = _shuffle(k1[i], k2[i], seed)
        jitter = np.float64(unit(mix(U(mix(U(seed ^ X)) ^ index))))
        o0[i] = _place(_real(index), jitter, _real(k2[i]))
        o1[i] = unit(reverse(scramble(index, mix(U(seed ^ Y)))))


@jit()
def _zsobol_1d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        o0[i] = unit(reverse(scramble(_curve(k1[i], seed), mix(U(seed ^ X)))))


@jit()
def _zsobol_2d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = _curve(k1[i], seed)
        o0[i] = unit(reverse(scramble(index, mix(U(seed ^ X)))))
        o1[i] = unit(reverse(scramble(second_dimension(index), mix(U(seed ^ Y)))))


@jit(inline="always")
def _range(body: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    if body == 0 or body == 2:
        _strata_1d(k0, k1, k2, salt, o0, o1)
    elif body == 1:
        _stratified_2d(k0, k1, k2, salt, o0, o1)
    elif body == 3:
        _hammersley_2d(k0, k1, k2, salt, o0, o1)
    elif body == 4:
        _zsobol_1d(k0, k1, k2, salt, o0, o1)
    else:
        _zsobol_2d(k0, k1, k2, salt, o0, o1)


@jit()
def serial(
    first: int, last: int, block: int, body: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """Blocks ``first`` to ``last`` of lanes."""
    a, b = first * block, min(last * block, len(k0))
    _range(body, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])


@jit(parallel=True)
def parallel(
    chunks: int, items: int, block: int, body: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """The same for all blocks, split over threads."""
    for chunk in nb.prange(chunks):
        a, b = items * chunk // chunks * block, min(items * (chunk + 1) // chunks * block, len(k0))
        _range(body, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])
