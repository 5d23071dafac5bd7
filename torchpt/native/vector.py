"""Pieces of loops that LLVM is to turn into vector code, the same in every kernel of that kind."""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit

__all__ = ["at", "larger", "smaller"]


@jit(forceinline=True)
def at(i):
    """An index that is never negative: numba's test for that would keep LLVM from using vectors."""
    return np.uint64(i)


@jit(forceinline=True)
def smaller(a, b):
    """The smaller number by one comparison, the second where either is NaN."""
    return a if a < b else b


@jit(forceinline=True)
def larger(a, b):
    """The larger number by one comparison, the second where either is NaN."""
    return a if a > b else b
