"""Machine code that adds values to entries of a table in a fixed order, and sorts lanes by sample.

It does the work of :mod:`torchpt.math.sums` on a CPU. There *table*, *entry*, *term* and *slot* are explained. An *arena* is
the memory of one thread, in which each field of its paths is a row, and a path is an index of all rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.kernels import kernel

__all__ = ["COLUMNS", "add_at", "add_by_columns", "sort_by_sample"]

#: Number of columns, a power of two: the threads of a GPU's warp.
COLUMNS = 32

Array = np.ndarray[Any, Any]


def sort_by_sample(
    lanes: Array, count: int, slot_of_lane: Array, slots: Array, lane_of_slot: Array, used: Array
) -> None:
    """Sort lanes, indices of an arena, by the slots of their samples.

    Args:
        lanes: int32, the first ``count`` of them sorted in place; its length is at least ``count + 1``.
        count: number of lanes.
        slot_of_lane: int32, the arena's row of slots; those of ``lanes`` are distinct.
        slots: int32, filled with the sorted slots; its length is at least ``count + 1``.
        lane_of_slot: int32 scratch memory, one element a slot.
        used: uint8 scratch memory, one element a slot, its length a multiple of 8: 0 before and after.
    """
    kernel("sums", "sort_by_sample")(lanes, count, slot_of_lane, slots, lane_of_slot, used, used.view(np.uint64))


def add_at(total: Array, index: Array, values: Array) -> None:
    """Add ``total[index[k], r] += values[r, k]`` for all k in order; indices out of range are skipped.

    Args:
        total: ``(M, R)`` sums of a table of M entries of R numbers, float64 or float32.
        index: ``(n,)`` int64 or int32, the entry of each term.
        values: ``(R, n)`` terms, float64 or float32.
    """
    entries, width = total.shape  # M, R
    values, stride = _rows(values)
    index = np.ascontiguousarray(index)
    name = f"add_at_{total.dtype.str[1:]}_{index.dtype.str[1:]}_{values.dtype.str[1:]}"
    kernel("sums", name)(total, entries, width, index, len(index), values.ctypes.data, stride)


def add_by_columns(total: Array, index: Array, values: Array, slots: Array) -> None:
    """Add as :func:`add_at`, but sum the terms of an entry by columns of slots first, see :mod:`torchpt.math.sums`.

    Args:
        total: ``(M, R)`` float64.
        index: ``(n,)`` int32.
        values: ``(R, n)`` float64 or float32.
        slots: ``(n,)`` int32, rising: slots of the samples to which the terms belong.
    """
    entries, width = total.shape
    values, stride = _rows(values)
    sums, column_index = np.empty(COLUMNS * entries * width), np.empty(len(index), np.int32)
    args = (total, entries, width, index, len(index), values.ctypes.data, stride, slots, sums, column_index)
    kernel("sums", f"add_by_columns_{values.dtype.str[1:]}")(*args)


def _rows(values: Array) -> tuple[Array, int]:
    """Return a table whose rows are contiguous, copied if they are not, and the distance between rows in elements."""
    if values.shape[1] > 1 and values.strides[1] != values.itemsize:
        values = np.ascontiguousarray(values)
    return values, values.strides[0] // values.itemsize
