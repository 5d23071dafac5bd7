"""Add values to entries of a table in a fixed order, and sort lanes by sample, for gradient sums.

:mod:`torchpt.math.sum_kernels` calls these kernels and documents their arguments. A table has ``entries`` of ``width`` numbers
each; ``values`` are rows of ``stride`` numbers, one for each number of an entry.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from kernel_sources.jit import DOUBLES, FLOATS, INT, INTS, LONGS, array, inner, kernel
from kernel_sources.simd import item, put
from torchpt.math.sum_kernels import COLUMNS

__all__ = ["sort_by_sample"]


@kernel("sums", array("i4"), INT, array("i4"), array("i4"), array("i4"), array("u1"), array("u8"))
def sort_by_sample(
    lanes: Any, count: int, slot_of_lane: Any, slots: Any, lane_of_slot: Any, used: Any, used_by_eight: Any
) -> None:
    """Sort lanes by slot, see :func:`torchpt.math.sum_kernels.sort_by_sample`.

    ``used_by_eight`` is the memory of ``used`` as uint64.
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
    k = 0
    for eight in range(used_by_eight.shape[0]):  # eight flags are tested at once
        if used_by_eight[eight]:
            for slot in range(8 * eight, 8 * eight + 8):  # without branches: the entry of an unused slot is overwritten
                lanes[k], slots[k] = lane_of_slot[slot], slot
                k += used[slot]
            used_by_eight[eight] = 0


@inner(forceinline=True)
def _add(total, k, value):
    """Add a value to number ``k``."""
    put(total, k, item(total, k) + value)


@inner()
def _add_at(total: Any, entries: int, width: int, index: Any, count: int, values: Any, stride: int) -> None:
    """Add column ``k`` of the values to entry ``index[k]``, in the order of k; indices out of range are left out."""
    first = 0
    while first + 3 <= width:  # unrolled by three: colours and vectors take half as long
        x, y, z = first * stride, (first + 1) * stride, (first + 2) * stride
        for k in range(count):
            row = item(index, k)
            if 0 <= row < entries:
                place = np.int64(row) * width + first
                _add(total, place, item(values, x + k))
                _add(total, place + 1, item(values, y + k))
                _add(total, place + 2, item(values, z + k))
        first += 3
    for r in range(first, width):
        for k in range(count):
            row = item(index, k)
            if 0 <= row < entries:
                _add(total, np.int64(row) * width + r, item(values, r * stride + k))


def _declare_add_at(totals: Any, indices: Any, terms: Any, name: str) -> None:
    """Declare a kernel ``add_at`` for totals, indices and terms of these types, see :mod:`torchpt.math.sum_kernels`."""

    @kernel("sums", totals, INT, INT, indices, INT, terms, INT, name=name)
    def add_at(total, entries, width, index, count, values, stride):
        _add_at(total, entries, width, index, count, values, stride)


for _totals, _total in ((DOUBLES, "f8"), (FLOATS, "f4")):
    for _indices, _index in ((LONGS, "i8"), (INTS, "i4")):
        for _terms, _term in ((DOUBLES, "f8"), (FLOATS, "f4")):
            _declare_add_at(_totals, _indices, _terms, f"add_at_{_total}_{_index}_{_term}")


@inner()
def _add_by_columns(total, entries, width, index, count, values, stride, slots, sums, column_index):
    """Add values in ``COLUMNS`` sums that are then added pairwise; a value's column is its slot modulo ``COLUMNS``."""
    for number in range(COLUMNS * entries * width):
        put(sums, number, 0.0)
    for k in range(count):
        row = item(index, k)
        put(column_index, k, np.int32((item(slots, k) & (COLUMNS - 1)) * entries + row if 0 <= row < entries else -1))
    _add_at(sums, COLUMNS * entries, width, column_index, count, values, stride)
    half = COLUMNS // 2
    numbers = entries * width
    while half:
        for column in range(half):
            for number in range(numbers):
                _add(sums, column * numbers + number, item(sums, (column + half) * numbers + number))
        half //= 2
    for number in range(numbers):
        _add(total, number, item(sums, number))


def _declare_add_by_columns(terms: Any, name: str) -> None:
    """Declare a kernel ``add_by_columns`` for terms of this type, see :mod:`torchpt.math.sum_kernels`."""

    @kernel("sums", DOUBLES, INT, INT, INTS, INT, terms, INT, INTS, DOUBLES, INTS, name=name)
    def add_by_columns(total, entries, width, index, count, values, stride, slots, sums, column_index):
        _add_by_columns(total, entries, width, index, count, values, stride, slots, sums, column_index)


_declare_add_by_columns(DOUBLES, "add_by_columns_f8")
_declare_add_by_columns(FLOATS, "add_by_columns_f4")
