"""Adding values to places of a table in a fixed order, and samples in theirs."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchpt.native.jit import jit

__all__ = ["BLOCK", "add_at", "add_by_blocks", "sort_by_sample", "sum_by_blocks"]

#: Slots of a block, whose terms are added one after the other.
BLOCK = 128


@jit()
def sort_by_sample(places: Any, count: int, lanes: Any, slots: Any, found: Any, taken: Any) -> None:
    """Sort places of an arena by the slots of the samples that are there.

    Args:
        places: int32 with one to spare, of which ``count`` are sorted in place.
        count: how many.
        lanes: the arena's row of slots, those of the places all different.
        slots: int32 with one to spare, where the slots go in their order.
        found: int32, one for each slot, to work in.
        taken: uint8, eight or a multiple for all slots: 0 before and after.
    """
    rising, before = True, -1
    for k in range(count):
        slot = lanes[places[k]]
        slots[k] = slot
        rising &= slot > before
        before = slot
    if rising:
        return
    for k in range(count):
        found[slots[k]] = places[k]
        taken[slots[k]] = 1
    k, eights = 0, taken.view(np.uint64)
    for eight in range(eights.shape[0]):
        if eights[eight]:
            for slot in range(8 * eight, 8 * eight + 8):  # without branches: what is not taken is written over
                places[k], slots[k] = found[slot], slot
                k += taken[slot]
            eights[eight] = 0


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


@jit()
def add_by_blocks(total: Any, index: Any, values: Any, slots: Any) -> None:
    """As :func:`add_at`, what an entry is given summed by blocks of slots first: see :mod:`torchpt.adjoint.sums`.

    Args:
        total: ``(M, R)`` float64.
        index: ``(n,)`` int32.
        values: ``(R, n)``.
        slots: ``(n,)`` int32, rising.
    """
    entries, width = total.shape
    whole, here = np.zeros((entries, width)), np.zeros((entries, width))
    blocks = np.full(entries, -1, np.int32)  # of what is in `here`
    for k in range(index.shape[0]):
        row = index[k]
        if 0 <= row < entries:
            block = slots[k] // BLOCK
            if block == blocks[row]:
                for r in range(width):
                    here[row, r] += values[r, k]
            else:
                blocks[row] = block
                for r in range(width):
                    whole[row, r] += here[row, r]
                    here[row, r] = values[r, k]
    for row in range(entries):
        if blocks[row] >= 0:
            for r in range(width):
                total[row, r] += whole[row, r] + here[row, r]


@jit()
def sum_by_blocks(total: Any, values: Any, slots: Any) -> None:
    """``total[r] += sum of values[r]``, summed as :func:`add_by_blocks` sums what one entry is given.

    Args:
        total: ``(R,)`` float64.
        values: ``(R, n)``.
        slots: ``(n,)`` int32, rising.
    """
    n, width = slots.shape[0], total.shape[0]
    whole = np.zeros(width)
    first = 0
    while first < n:
        block, last = slots[first] // BLOCK, first + 1
        while last < n and slots[last] // BLOCK == block:
            last += 1
        for r in range(width):
            here = 0.0
            for k in range(first, last):
                here += values[r, k]
            whole[r] += here
        first = last
    for r in range(width):
        total[r] += whole[r]
