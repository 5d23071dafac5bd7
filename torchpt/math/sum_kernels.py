"""Numba kernels that add values to entries of a table in a fixed order, and sort lanes by sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.jit import jit

__all__ = ["COLUMNS", "add_at", "add_by_columns", "sort_by_sample"]

#: Number of columns, a power of two: the threads of a GPU's warp.
COLUMNS = 32


@jit()
def sort_by_sample(places: Any, count: int, lanes: Any, slots: Any, found: Any, taken: Any) -> None:
    """Sort indices of an arena by the slots of the samples in these lanes.

    Args:
        places: int32 indices, ``count`` of them sorted in place; its length is at least ``count + 1``.
        count: number of indices.
        lanes: the arena's row of slots; the slots at the indices are distinct.
        slots: int32, filled with the sorted slots; its length is at least ``count + 1``.
        found: int32 scratch memory, one element a slot.
        taken: uint8 scratch memory, one element a slot, its length a multiple of 8: 0 before and after.
    """
    for k in range(count):
        slots[k] = lanes[np.uint32(places[k])]
    falls = 0
    for k in range(1, count):
        falls |= slots[k] < slots[k - 1]
    if not falls:
        return
    for k in range(count):
        found[slots[k]] = places[k]
        taken[slots[k]] = 1
    k, eights = 0, taken.view(np.uint64)
    for eight in range(eights.shape[0]):
        if eights[eight]:
            for slot in range(8 * eight, 8 * eight + 8):  # without branches: an unused entry is overwritten
                places[k], slots[k] = found[slot], slot
                k += taken[slot]
            eights[eight] = 0


@jit()
def add_at(total: Any, index: Any, values: Any) -> None:
    """Add ``total[index[k], r] += values[r, k]`` for all k in order; indices out of range are skipped.

    Args:
        total: ``(M, R)``.
        index: ``(n,)`` int64 or int32.
        values: ``(R, n)``.
    """
    entries, width = total.shape
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
        total: ``(M, R)`` float64.
        index: ``(n,)`` int32.
        values: ``(R, n)``.
        slots: ``(n,)`` int32, rising.
    """
    entries, width = total.shape
    sums, places = np.zeros((COLUMNS, entries * width)), np.empty(index.shape[0], np.int32)
    for k in range(index.shape[0]):
        row = index[k]
        places[k] = (slots[k] & (COLUMNS - 1)) * entries + row if 0 <= row < entries else -1
    add_at(sums.reshape(COLUMNS * entries, width), places, values)
    half = COLUMNS // 2
    while half:
        for column in range(half):
            for number in range(entries * width):
                sums[column, number] += sums[column + half, number]
        half //= 2
    for row in range(entries):
        for r in range(width):
            total[row, r] += sums[0, row * width + r]
