"""Kernels that the samplers share whose points stand in strata; the tensor forms are in ``shuffling.py`` and ``strata.py``."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.jit import jit
from torchpt.samplers.kernels_bits import SCALE, U, X, mix, unit
from torchpt.samplers.shuffling import ROUNDS, STEP, STRIDE

__all__ = ["place", "real", "shuffle", "strata_1d"]

_LEVELS = np.float64(1 << 24)
_STRIDE, _STEP = U(STRIDE), U(STEP & 0xFFFFFFFF)


@jit(inline="always")
def _pivot(seed: Any, count: Any) -> Any:
    return U((np.uint64(seed >> U(1)) * np.uint64(count)) >> np.uint64(31))


@jit(inline="always")
def shuffle(index: Any, count: Any, seed: Any) -> Any:
    """As ``shuffling.shuffle``."""
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
def place(stratum: Any, jitter: Any, count: Any) -> Any:
    """As ``strata.place``."""
    level = np.floor((stratum + jitter) / count * _LEVELS)
    return np.float32(np.int32(min(level, _LEVELS - 1.0))) * SCALE


@jit(inline="always")
def real(x: Any) -> Any:
    """A whole number below 2^31 as float64."""
    return np.float64(np.int32(x))


@jit()
def strata_1d(k0: Any, k1: Any, k2: Any, salt: Any, o0: Any, o1: Any) -> None:
    """As ``strata.jittered``."""
    for i in range(len(k0)):
        seed = mix(U(k0[i] ^ salt))
        stratum = shuffle(k1[i], k2[i], seed)
        jitter = np.float64(unit(mix(U(mix(U(seed ^ X)) ^ stratum))))
        o0[i] = place(real(stratum), jitter, real(k2[i]))
