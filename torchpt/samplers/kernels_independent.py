"""Kernels of the ``independent`` sampler."""

from __future__ import annotations

from typing import Any

import numba as nb

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import SECOND, U, mix, unit

__all__ = ["parallel", "serial"]


@jit()
def _independent_1d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        o0[i] = unit(mix(U(mix(U(k1[i] ^ salt)) + k0[i])))


@jit()
def _independent_2d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        word = mix(U(mix(U(k1[i] ^ salt)) + k0[i]))
        o0[i] = unit(word)
        o1[i] = unit(mix(U(word ^ SECOND)))


@jit(inline="always")
def _range(rows: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    if rows == 1:
        _independent_1d(k0, k1, salt, o0, o1)
    else:
        _independent_2d(k0, k1, salt, o0, o1)


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
