"""The samplers' integer arithmetic as CPU kernels: the same bits as the tensor form, ten times faster.

A point takes some hundred integer operations, each a pass over memory as a tensor operation; here they stay in registers.
The tensor form beside it is the reference, and what other devices use.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchpt.native.jit import jit, launch, thread_count

__all__ = ["draw"]

U = np.uint32
_M0, _M1 = U(0x7FEB352D), U(0x846CA68B)
_K0, _K1, _K2 = U(0x3D20ADEA), U(0x05526C56), U(0x53A22864)
_X, _Y, _SECOND = U(0x68BC21EB), U(0x02E5BE93), U(0x9E3779B9)
_SCALE = np.float32(1.0 / (1 << 24))
#: Lanes a thread takes at once.
BLOCK = 1024


@jit(inline="always")
def _mix(x: Any) -> Any:
    x = U(U(x ^ (x >> U(16))) * _M0)
    x = U(U(x ^ (x >> U(15))) * _M1)
    return U(x ^ (x >> U(16)))


@jit(inline="always")
def _reverse(x: Any) -> Any:
    x = U(((x >> U(1)) & U(0x55555555)) | ((x & U(0x55555555)) << U(1)))
    x = U(((x >> U(2)) & U(0x33333333)) | ((x & U(0x33333333)) << U(2)))
    x = U(((x >> U(4)) & U(0x0F0F0F0F)) | ((x & U(0x0F0F0F0F)) << U(4)))
    x = U(((x >> U(8)) & U(0x00FF00FF)) | ((x & U(0x00FF00FF)) << U(8)))
    return U((x >> U(16)) | (x << U(16)))


@jit(inline="always")
def _scramble(x: Any, seed: Any) -> Any:
    x = U(x ^ U(x * _K0))
    x = U(x + seed)
    x = U(x * U((seed >> U(16)) | U(1)))
    x = U(x ^ U(x * _K1))
    return U(x ^ U(x * _K2))


@jit(inline="always")
def _second_dimension(x: Any) -> Any:
    x = U(x ^ ((x >> U(16)) & U(0x0000FFFF)))
    x = U(x ^ ((x >> U(8)) & U(0x00FF00FF)))
    x = U(x ^ ((x >> U(4)) & U(0x0F0F0F0F)))
    x = U(x ^ ((x >> U(2)) & U(0x33333333)))
    return U(x ^ ((x >> U(1)) & U(0x55555555)))


@jit(inline="always")
def _unit(x: Any) -> Any:
    return np.float32(np.int32(x >> U(8))) * _SCALE


# Rows are separate one-dimensional arrays: indexed as rows of one array, the loops are not turned into vector code.


@jit()
def _sobol_1d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = _mix(U(k0[i] ^ salt))
        index = _reverse(_scramble(_reverse(k1[i]), seed))
        o0[i] = _unit(_reverse(_scramble(index, _mix(U(seed ^ _X)))))


@jit()
def _sobol_2d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        seed = _mix(U(k0[i] ^ salt))
        index = _reverse(_scramble(_reverse(k1[i]), seed))
        o0[i] = _unit(_reverse(_scramble(index, _mix(U(seed ^ _X)))))
        o1[i] = _unit(_reverse(_scramble(_second_dimension(index), _mix(U(seed ^ _Y)))))


@jit()
def _independent_1d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        o0[i] = _unit(_mix(U(_mix(U(k1[i] ^ salt)) + k0[i])))


@jit()
def _independent_2d(k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for i in range(len(k0)):
        word = _mix(U(_mix(U(k1[i] ^ salt)) + k0[i]))
        o0[i] = _unit(word)
        o1[i] = _unit(_mix(U(word ^ _SECOND)))


@jit(inline="always")
def _range(body: int, k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    if body == 0:
        _sobol_1d(k0, k1, salt, o0, o1)
    elif body == 1:
        _sobol_2d(k0, k1, salt, o0, o1)
    elif body == 2:
        _independent_1d(k0, k1, salt, o0, o1)
    else:
        _independent_2d(k0, k1, salt, o0, o1)


@jit()
def _serial(first: int, last: int, body: int, k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    a, b = first * BLOCK, min(last * BLOCK, len(k0))
    _range(body, k0[a:b], k1[a:b], salt, o0[a:b], o1[a:b])


@jit(parallel=True)
def _parallel(chunks: int, items: int, body: int, k0: Any, k1: Any, salt: Any, o0: Any, o1: Any) -> None:
    for chunk in nb.prange(chunks):
        a, b = items * chunk // chunks * BLOCK, min(items * (chunk + 1) // chunks * BLOCK, len(k0))
        _range(body, k0[a:b], k1[a:b], salt, o0[a:b], o1[a:b])


def draw(kind: str, rows: int, key: Tensor, salt: int) -> Tensor:
    """``(rows, N)`` float32 in ``[0, 1)``: the bits of ``draw_1d`` or ``draw_2d`` of the sampler ``kind``."""
    n = key.shape[1]
    out = torch.empty(rows, n, dtype=torch.float32)
    if n:
        words, values = key.contiguous().numpy().view(np.uint32), out.numpy()
        body = 2 * (kind == "independent") + rows - 1
        arguments = (body, words[0], words[1], U(salt & 0xFFFFFFFF), values[0], values[-1])
        launch(_serial, _parallel, -(-n // BLOCK), thread_count(None), 16, arguments)
    return out
