"""Kernels of the ``stratified`` sampler."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import U, X, Y, mix, unit
from torchpt.samplers.kernels_strata import place, real, shuffle, strata_1d

__all__ = ["parallel", "serial"]


@jit()
def _stratified_2d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        stratum = shuffle(k1[i], k2[i], seed)
        x = np.float64(unit(mix(U(mix(U(seed ^ X)) ^ stratum))))
        y = np.float64(unit(mix(U(mix(U(seed ^ Y)) ^ stratum))))
        k, count = real(stratum), real(k2[i])
        columns = np.floor(np.sqrt(count) + 0.5)
        column = np.floor(((k + 1.0) * columns - 1.0) / count)
        first, end = np.floor(column * count / columns), np.floor((column + 1.0) * count / columns)
        rows = end - first
        o0[i] = place(first, x * rows, count)
        o1[i] = place(k - first, y, rows)


@jit(inline="always")
def _range(rows: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    if rows == 1:
        strata_1d(k0, k1, k2, salt, o0, o1)
    else:
        _stratified_2d(k0, k1, k2, salt, o0, o1)


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
