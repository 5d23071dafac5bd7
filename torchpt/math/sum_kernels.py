"""Numba kernels that add values to entries of a table in a fixed order, and sort lanes by sample.

They do the work of :mod:`torchpt.math.sums` on a CPU. There *table*, *entry*, *term* and *slot* are explained. An *arena* is
the memory of one thread, in which each field of its paths is a row, and a path is an index of all rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.jit import jit

__all__ = ["COLUMNS", "add_at", "add_by_columns", "sort_by_sample"]

#: Number of columns, a power of two: the threads of a GPU's warp.
COLUMNS = 32


@jit()
def sort_by_sample(lanes: Any, count: int, slot_of_lane: Any, slots: Any, lane_of_slot: Any, used: Any) -> None:
    """Sort lanes, indices of an arena, by the slots of their samples.

    Args:
        lanes: int32, the first ``count`` of them sorted in place; its length is at least ``count + 1``.
        count: number of lanes.
        slot_of_lane: the arena's row of slots; those of ``lanes`` are distinct.
        slots: int32, filled with the sorted slots; its length is at least ``count + 1``.
        lane_of_slot: int32 scratch memory, one element a slot.
        used: uint8 scratch memory, one element a slot, its length a multiple of 8: 0 before and after.
    """
    for k in range(count):
        slots[k] = slot_of_lane[np.uint32(lanes[k])]  # unsigned: numba leaves out the test for indices below 0
    unsorted = 0
    for k in range(1, count):
        unsorted |= slots[k] < slots[k - 1]
    if not unsorted:
        return
    for k in range(count):
        lane_of_slot[slots[k]] = lanes[k]
        used[slots[k]] = 1
    k, used_by_eight = 0, used.view(np.uint64)  # eight flags are tested at once
    for eight in range(used_by_eight.shape[0]):
        if used_by_eight[eight]:
            for slot in range(8 * eight, 8 * eight + 8):  # without branches: the entry of an unused slot is overwritten
                lanes[k], slots[k] = lane_of_slot[slot], slot
                k += used[slot]
            used_by_eight[eight] = 0


@jit()
def add_at(total: Any, index: Any, values: Any) -> None:
    """Add ``total[index[k], r] += values[r, k]`` for all k in order; indices out of range are skipped.

    Args:
        total: ``(M, R)`` sums of a table of M entries of R numbers.
        index: ``(n,)`` int64 or int32, the entry of each term.
        values: ``(R, n)`` terms.
    """
    entries, width = total.shape  # M, R
    first = 0
    while first + 3 <= width:  # unrolled by three: colours and vectors take half as long
        x, y, z = values[first], values[first + 1], values[first + 2]
        for k in range(index.shape[0]):
            row = index[k]
            if 0 <= row < entries:
                total[row, first] += x[k]
                total[row, first + 1] += y[k]
                total[row, first + 2] += z[k]
        first += 3
    for r in range(first, width):
        for k in range(index.shape[0]):
            row = index[k]
            if 0 <= row < entries:
                total[row, r] += values[r, k]


@jit()
def add_by_columns(total: Any, index: Any, values: Any, slots: Any) -> None:
    """Add as :func:`add_at`, but sum the terms of an entry by columns of slots first, see :mod:`torchpt.math.sums`.

    Args:
        total: ``(M, R)`` float64, as for :func:`add_at`, and so are ``index`` (int32) and ``values``.
        index: ``(n,)`` int32.
        values: ``(R, n)``.
        slots: ``(n,)`` int32, rising: slots of the samples to which the terms belong.
    """
    entries, width = total.shape
    # The columns are one table of COLUMNS * M entries, in which a term is added to the entry of its slot's column.
    sums, column_index = np.zeros((COLUMNS, entries * width)), np.empty(index.shape[0], np.int32)
    for k in range(index.shape[0]):
        row = index[k]
        column_index[k] = (slots[k] & (COLUMNS - 1)) * entries + row if 0 <= row < entries else -1
    add_at(sums.reshape(COLUMNS * entries, width), column_index, values)
    half = COLUMNS // 2
    while half:
        for column in range(half):
            for number in range(entries * width):
                sums[column, number] += sums[column + half, number]
        half //= 2
    for row in range(entries):
        for r in range(width):
            total[row, r] += sums[0, row * width + r]
