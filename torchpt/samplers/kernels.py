"""Samplers' integer arithmetic as CPU kernels: the same bits as the tensor form, ten times faster.

A point takes some hundred integer operations, each a pass over memory as a tensor operation; here they stay in registers.
The tensor form beside it is the reference, and what other devices use.

The kernels of a kind are a module of their own, so that they are compiled only where they are used, with two functions:

    serial(first, last, block, what, k0, k1, k2, salt, o0, o1)        blocks ``first`` to ``last`` of lanes
    parallel(chunks, items, block, what, k0, k1, k2, salt, o0, o1)    all of them, split over threads

``what`` is 1 or 2 for as many numbers a lane, ``FURTHER`` for the two that a set of two goes on with. They are made of the
key's rows ``k0``, ``k1`` and (the last one) ``k2`` and go into ``o0`` and ``o1``. Both are written out in each module: numba
does not keep on disk what is made of other kernels by a function. Rows are separate one-dimensional arrays: indexed as rows
of one array, the loops are not turned into vector code.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchpt.native.jit import launch
from torchpt.native.threads import thread_count
from torchpt.samplers.base import Points
from torchpt.samplers.kernels_bits import FURTHER, U

__all__ = ["draw"]

#: Lanes a thread takes at once.
BLOCK = 1024


def draw(points: Points, rows: int, key: Tensor, salt: int, further: bool = False) -> Tensor:
    """``(rows, N)`` float32 in ``[0, 1)``: the bits of ``draw_1d``, ``draw_2d`` or ``draw_further``, from kernels."""
    n = key.shape[1]
    out = torch.empty(rows, n, dtype=torch.float32)
    if n:
        words, values, kernels = key.contiguous().numpy().view(np.uint32), out.numpy(), points.kernels()
        what = FURTHER if further else rows
        arguments = (BLOCK, what, words[0], words[1], words[-1], U(salt & 0xFFFFFFFF), values[0], values[-1])
        launch(kernels.serial, kernels.parallel, -(-n // BLOCK), thread_count(None), 16, arguments)
    return out
