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

from torchpt.native.jit import jit, launch
from torchpt.native.threads import thread_count
from torchpt.samplers.kernels_bits import SECOND, U, X, Y, mix, reverse, scramble, second_dimension, unit

__all__ = ["draw"]

#: Lanes a thread takes at once.
BLOCK = 1024


# Rows are separate one-dimensional arrays: indexed as rows of one array, the loops are not turned into vector code.


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
        name, ends = U(salt & 0xFFFFFFFF), (values[0], values[-1])
        if kind in ("sobol", "independent"):
            body = 2 * (kind == "independent") + rows - 1
            run, split, arguments = _serial, _parallel, (body, words[0], words[1], name, *ends)
        else:
            from torchpt.samplers import kernels_counted as counted

            body = 2 * counted.BODIES.index(kind) + rows - 1
            run, split = counted.serial, counted.parallel
            arguments = (BLOCK, body, words[0], words[1], words[-1], name, *ends)
        launch(run, split, -(-n // BLOCK), thread_count(None), 16, arguments)
    return out
