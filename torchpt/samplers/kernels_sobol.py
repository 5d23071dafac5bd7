"""Kernels of the ``sobol`` sampler."""

from __future__ import annotations

from typing import Any

import numba as nb

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import (
    FURTHER,
    U,
    W,
    X,
    Y,
    Z,
    fourth_dimension,
    mix,
    reverse,
    scramble,
    second_dimension,
    third_dimension,
    unit,
)

__all__ = ["parallel", "serial"]


@jit()
def _sobol_1d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = reverse(scramble(reverse(k1[i]), seed))
        o0[i] = unit(reverse(scramble(index, mix(U(seed ^ X)))))


@jit()
def _sobol_2d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = reverse(scramble(reverse(k1[i]), seed))
        o0[i] = unit(reverse(scramble(index, mix(U(seed ^ X)))))
        o1[i] = unit(reverse(scramble(second_dimension(index), mix(U(seed ^ Y)))))


@jit()
def _sobol_further(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        index = reverse(scramble(reverse(k1[i]), seed))
        o0[i] = unit(reverse(scramble(third_dimension(index), mix(U(seed ^ Z)))))
        o1[i] = unit(reverse(scramble(fourth_dimension(index), mix(U(seed ^ W)))))


@jit(inline="always")
def _range(what: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    if what == 1:
        _sobol_1d(k0, k1, salt, o0, o1)
    elif what == FURTHER:
        _sobol_further(k0, k1, salt, o0, o1)
    else:
        _sobol_2d(k0, k1, salt, o0, o1)


@jit()
def serial(
    first: int, last: int, block: int, what: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """See :mod:`torchpt.samplers.kernels`."""
    a, b = first * block, min(last * block, len(k0))
    _range(what, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])


@jit(parallel=True)
def parallel(
    chunks: int, items: int, block: int, what: int, k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any
) -> None:
    """See :mod:`torchpt.samplers.kernels`."""
    for chunk in nb.prange(chunks):
        a, b = items * chunk // chunks * block, min(items * (chunk + 1) // chunks * block, len(k0))
        _range(what, k0[a:b], k1[a:b], k2[a:b], salt, o0[a:b], o1[a:b])
