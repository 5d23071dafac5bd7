"""Adding values to places of a table, one after the other: the order of a sum is that of its terms."""

from __future__ import annotations

from typing import Any

from torchpt.native.jit import jit

__all__ = ["add_at"]


@jit()
def add_at(total: Any, index: Any, values: Any) -> None:
    """``total[index[k], r] += values[r, k]`` for all k in their order; an index beyond the table adds nothing.

    Args:
        total: ``(M, R)``.
        index: ``(n,)`` int64 or int32.
        values: ``(R, n)``.
    """
    for k in range(index.shape[0]):
        row = index[k]
        if 0 <= row < total.shape[0]:
            for r in range(total.shape[1]):
                total[row, r] += values[r, k]
