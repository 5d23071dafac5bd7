"""Cells of photons, and the photon that a vertex is merged with; see :mod:`torchpt.paths.photons`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.np.numpy_support import carray

from kernel_sources.jit import FLOATS, INT, INTS, inner, kernel
from kernel_sources.simd import item, put, stack_memory

__all__ = ["cells_of", "near"]

#: Photons of a vertex that are kept in memory while one of them is chosen; of more they are visited twice.
KEPT = 256
#: Told apart, so that coordinates in another order have another cell.
SALT_X, SALT_Y, SALT_Z = 0x0, 0x51ED270B, 0x2545F491


@inner(forceinline=True)
def _mix(x):
    """Hash 32 bits, as :func:`torchpt.math.hashing.mix_int` does."""
    x = np.uint32(x)
    x = np.uint32(np.uint32(x ^ (x >> np.uint32(16))) * np.uint32(0x7FEB352D))
    x = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@inner(forceinline=True)
def _part(x, salt):
    """Return the part of a coordinate in the number of a cell, which is the exclusive or of three, below a power of 2."""
    return _mix(np.uint32((x + salt) & 0xFFFFFFFF))


@inner(forceinline=True)
def _floor(x):
    """Return the largest integer that is not above a float32."""
    whole = np.int64(x)
    return whole - np.int64(np.float32(whole) > x)


@kernel("photons", FLOATS, INT, FLOATS, INT, INTS)
def cells_of(p: Any, count: int, inverse: Any, cells: int, cell: Any) -> None:
    """Write the cell of each point ``p (3, count)``; ``inverse``: one over the width of a cell."""
    for k in range(count):
        x = _floor(item(p, k) * item(inverse, 0))
        y = _floor(item(p, count + k) * item(inverse, 0))
        z = _floor(item(p, 2 * count + k) * item(inverse, 0))
        number = _part(x, SALT_X) ^ _part(y, SALT_Y) ^ _part(z, SALT_Z)
        put(cell, k, np.int32(np.int64(number) & (cells - 1)))


@inner(forceinline=True)
def _flip(corner, x, y, z):
    """Return what the axes on whose far side a corner lies change in the number of a cell."""
    zero = np.uint32(0)
    return (x if corner & 1 else zero) ^ (y if corner & 2 else zero) ^ (z if corner & 4 else zero)


@inner()
def _scan(points, starts, cells, x, y, z, radius, inverse, most, sums, kept):
    """Add the weights of photons within the radius of a point, until the sum exceeds ``most``.

    Returns:
        The sum; the last photon that was added, -1: none; and the number of those in ``kept``, with the sums up to each in
        ``sums``, unless there are more than ``KEPT``.
    """
    x0, y0, z0 = _floor((x - radius) * inverse), _floor((y - radius) * inverse), _floor((z - radius) * inverse)
    mask = np.uint32(cells - 1)
    low_x, low_y, low_z = _part(x0, SALT_X) & mask, _part(y0, SALT_Y) & mask, _part(z0, SALT_Z) & mask
    # What the other cell of each axis changes in the number.
    flip_x = (_part(x0 + 1, SALT_X) & mask) ^ low_x
    flip_y = (_part(y0 + 1, SALT_Y) & mask) ^ low_y
    flip_z = (_part(z0 + 1, SALT_Z) & mask) ^ low_z
    first = low_x ^ low_y ^ low_z
    square, total, last, count = radius * radius, 0.0, np.int64(-1), np.int64(0)
    for corner in range(8):
        cell = first ^ _flip(corner, flip_x, flip_y, flip_z)
        seen = False
        for other in range(corner):  # two of the cells may have one number
            seen |= cell == first ^ _flip(other, flip_x, flip_y, flip_z)
        if seen:
            continue
        for k in range(np.int64(item(starts, cell)), np.int64(item(starts, cell + 1))):
            dx, dy, dz = item(points, 4 * k) - x, item(points, 4 * k + 1) - y, item(points, 4 * k + 2) - z
            if dx * dx + dy * dy + dz * dz < square:
                total += np.float64(item(points, 4 * k + 3))
                last = k
                if total > most:
                    return total, last, count
                if count < KEPT:
                    sums[count], kept[count] = total, k
                count += 1
    return total, last, count


@kernel("photons", FLOATS, INT, INTS, INT, INT, FLOATS, FLOATS, INTS, INT, FLOATS, FLOATS)
def near(p, count, keys, rows, salt, points, data, starts, cells, numbers, found):
    """Write to ``found (9, count)`` the data of one photon within the radius of each point, drawn by its weight.

    Args:
        p: points ``(3, count)``.
        count: number of points.
        keys: the sampler's keys ``(rows, count)``.
        rows: of a key.
        salt: of the dimension.
        points: photons ``(n, 4)``.
        data: their data ``(n, 9)``: direction, value, ``dvcm``, ``dvc``, depth.
        starts: first photon of each cell.
        cells: number of cells, a power of 2.
        numbers: radius, and scale of values.
        found: the results; 0 where there is no photon.
    """
    radius, scale = item(numbers, 0), item(numbers, 1)
    inverse = np.float32(0.5) / radius
    sums, kept = carray(stack_memory(KEPT, np.float64), (KEPT,)), carray(stack_memory(KEPT, np.int64), (KEPT,))
    for lane in range(count):
        x, y, z = item(p, lane), item(p, count + lane), item(p, 2 * count + lane)
        total, chosen, visited = _scan(points, starts, cells, x, y, z, radius, inverse, math.inf, sums, kept)
        if not total > 0.0:
            for row in range(9):
                put(found, row * count + lane, np.float32(0.0))
            continue
        hashed = np.uint32(salt & 0xFFFFFFFF)
        for row in range(rows):
            hashed = _mix(np.uint32(hashed ^ np.uint32(np.int64(item(keys, row * count + lane)) & 0xFFFFFFFF)))
        part = np.float64(np.int64(hashed)) * (total / 4294967296.0)
        if visited > KEPT:
            _, chosen, _ = _scan(points, starts, cells, x, y, z, radius, inverse, part, sums, kept)
        else:
            for k in range(visited):
                if sums[k] > part:
                    chosen = kept[k]
                    break
        factor = np.float32(total / np.float64(item(points, 4 * chosen + 3))) * scale
        for row in range(9):
            value = item(data, 9 * chosen + row)
            put(found, row * count + lane, value * factor if 3 <= row < 6 else value)
