"""Cells of photons, and the photon that a vertex is merged with; see :mod:`torchpt.paths.photons`."""

from __future__ import annotations

import math

import numpy as np
from numba.np.numpy_support import carray

from kernel_sources.jit import FLOATS, INT, INTS, LONGS, inner, kernel
from kernel_sources.simd import bits, item, lane_numbers, load, prefetch, put, splat, stack_memory, trailing_zeros
from torchpt.paths.photons import FIRST_ROW, PHOTON_ROWS, TESTED

__all__ = ["build", "near"]

#: Photons of a vertex that are kept in memory while one of them is chosen; of more they are visited twice.
KEPT = 256
#: Vertices that are looked at together, so that the memory of all is asked for before it is read.
GROUP = 16
CORNERS, COORDINATES = 8 * GROUP, 3 * GROUP
#: Rows of a photon's data, and with its point; the first of its value.
ROWS, WIDTH, VALUE = PHOTON_ROWS, 3 + PHOTON_ROWS, FIRST_ROW["value"]
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
def _part(x, salt, shift):
    """Return the part of a coordinate in the number of a cell, which is the exclusive or of three, below a power of 2.

    Blocks of 4 x 4 x 4 cells lie side by side, so that the cells around a point are near to each other in memory.
    """
    return np.uint32(_mix(np.uint32(((x >> 2) + salt) & 0xFFFFFFFF)) << np.uint32(6)) ^ np.uint32((x & 3) << shift)


@inner(forceinline=True)
def _floor(x):
    """Return the largest integer that is not above a float32."""
    whole = np.int64(x)
    return whole - np.int64(np.float32(whole) > x)


@inner(forceinline=True)
def _cell(x, y, z, mask):
    """Return the number of a cell."""
    return (_part(x, SALT_X, 0) ^ _part(y, SALT_Y, 2) ^ _part(z, SALT_Z, 4)) & mask


@inner()
def _sort(order, first, last, rank):
    """Sort ``order[first:last]`` by the rank of its entries, by Shell's method with the gaps of Knuth."""
    gap = np.int64(1)
    while 3 * gap + 1 < last - first:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(first + gap, last):
            entry = item(order, i)
            mine, k = item(rank, entry), i
            while k >= first + gap and item(rank, item(order, k - gap)) > mine:
                put(order, k, item(order, k - gap))
                k -= gap
            put(order, k, entry)
        gap //= 3


@kernel("photons", FLOATS, FLOATS, LONGS, INT, FLOATS, INT, INTS, INTS, INTS, FLOATS, INT, FLOATS)
def build(photons, chance, rank, count, inverse, cells, starts, cell, order, points, size, sorted_data):
    """Sort photons by cell, and within a cell by their rank.

    Args:
        photons: their points and data ``(count, 12)``.
        chance: ``(count,)`` what the chances to be chosen are proportional to.
        rank: ``(count,)``.
        count: number of photons.
        inverse: ``(1,)`` one over the width of a cell.
        cells: number of cells, a power of 2.
        starts: ``(cells + 1,)`` zeros; becomes the first photon of each cell.
        cell: ``(count,)`` for the kernel's use.
        order: ``(count,)`` likewise.
        points: ``(4, size)`` the results: points and chances.
        size: of a row of them.
        sorted_data: ``(count, 9)``.
    """
    scale, mask = item(inverse, 0), np.uint32(cells - 1)
    for k in range(count):
        x, y, z = (
            item(photons, WIDTH * k) * scale,
            item(photons, WIDTH * k + 1) * scale,
            item(photons, WIDTH * k + 2) * scale,
        )
        number = np.int64(_cell(_floor(x), _floor(y), _floor(z), mask))
        put(cell, k, np.int32(number))
        put(starts, number + 1, item(starts, number + 1) + np.int32(1))
    total = np.int32(0)
    for number in range(cells):
        total += item(starts, number + 1)
        put(starts, number + 1, total)
    for k in range(count - 1, -1, -1):  # moves each start from the first photon of the next cell to its own
        number = np.int64(item(cell, k)) + 1
        place = item(starts, number) - np.int32(1)
        put(starts, number, place)
        put(order, np.int64(place), np.int32(k))
    for number in range(cells):
        put(starts, number, item(starts, number + 1))
    put(starts, cells, np.int32(count))
    for number in range(cells):
        first, last = np.int64(item(starts, number)), np.int64(item(starts, number + 1))
        if last - first > 1:
            _sort(order, first, last, rank)
    for place in range(count):
        k = np.int64(item(order, place))
        for row in range(3):
            put(points, row * size + place, item(photons, WIDTH * k + row))
        put(points, 3 * size + place, item(chance, k))
        for row in range(ROWS):
            put(sorted_data, ROWS * place + row, item(photons, WIDTH * k + 3 + row))


@inner(forceinline=True)
def _flip(corner, x, y, z):
    """Return what the axes on whose far side a corner lies change in the number of a cell."""
    zero = np.uint32(0)
    return (x if corner & 1 else zero) ^ (y if corner & 2 else zero) ^ (z if corner & 4 else zero)


@inner()
def _find_cells(starts, cells, x, y, z, radius, inverse, numbers, first):
    """Write the cells that a sphere meets to ``numbers[first : first + 8]``, and prefetch their starts."""
    x0, y0, z0 = _floor((x - radius) * inverse), _floor((y - radius) * inverse), _floor((z - radius) * inverse)
    mask = np.uint32(cells - 1)
    low_x, low_y, low_z = _part(x0, SALT_X, 0), _part(y0, SALT_Y, 2), _part(z0, SALT_Z, 4)
    # What the other cell of each axis changes in the number.
    flip_x = _part(x0 + 1, SALT_X, 0) ^ low_x
    flip_y = _part(y0 + 1, SALT_Y, 2) ^ low_y
    flip_z = _part(z0 + 1, SALT_Z, 4) ^ low_z
    low = low_x ^ low_y ^ low_z
    for corner in range(8):
        cell = np.int64((low ^ _flip(corner, flip_x, flip_y, flip_z)) & mask)
        put(numbers, first + corner, cell)
        prefetch(starts, cell)


@inner()
def _find_photons(points, row, starts, numbers, begins, ends, first):
    """Write the first and the last photon of eight cells, none of cells that came before, and prefetch their points."""
    for corner in range(first, first + 8):
        cell = item(numbers, corner)
        seen = False
        for other in range(first, corner):  # two of the cells may have one number
            seen |= cell == item(numbers, other)
        begin, end = np.int64(item(starts, cell)), np.int64(item(starts, cell + 1))
        end = begin if seen else end
        put(begins, corner, begin)
        put(ends, corner, end)
        if begin < end:
            for axis in range(4):
                prefetch(points, axis * row + begin)
                prefetch(points, axis * row + end - 1)


@inner()
def _scan(points, row, x, y, z, radius, most, sums, kept, begins, ends, first):
    """Add the chances of photons within the radius of a point, until the sum exceeds ``most``.

    Returns:
        The sum; the last photon that was added, -1: none; and the number of those in ``kept``, with the sums up to each in
        ``sums``, unless there are more than ``KEPT``.
    """
    px, py, pz, square = splat(x, TESTED), splat(y, TESTED), splat(z, TESTED), splat(radius * radius, TESTED)
    numbers_of_lanes, total, last, count = lane_numbers(TESTED), 0.0, np.int64(-1), np.int64(0)
    for corner in range(first, first + 8):
        end = item(ends, corner)
        for k in range(item(begins, corner), end, TESTED):
            dx, dy, dz = (
                load(points, k, TESTED) - px,
                load(points, row + k, TESTED) - py,
                load(points, 2 * row + k, TESTED) - pz,
            )
            inside = (dx * dx + dy * dy + dz * dz < square) & (numbers_of_lanes < splat(np.int32(end - k), TESTED))
            left = bits(inside)
            while left != 0:
                photon = k + trailing_zeros(left)
                left &= left - 1
                total += np.float64(item(points, 3 * row + photon))
                last = photon
                if total > most:
                    return total, last, count
                if count < KEPT:
                    sums[count], kept[count] = total, photon
                count += 1
    return total, last, count


@kernel("photons", FLOATS, INTS, INT, INTS, INT, INTS, INT, FLOATS, INT, FLOATS, INTS, INT, FLOATS)
def near(floats, words, stride, lanes, count, rows, salt, points, size, data, starts, cells, scales):
    """Write to lanes of an arena the data of one photon within the radius of their rays' hits, drawn by its chance.

    Args:
        floats: the arena, rows of ``stride`` words.
        words: the same memory.
        stride: see ``floats``.
        lanes: ``(count,)``.
        count: number of lanes.
        rows: first rows of o, d, t and the sampler's keys; number of rows of a key; first row of the results.
        salt: of the dimension.
        points: photons ``(4, size)``: points and chances.
        size: of a row of them, the number of photons and some more.
        data: their data ``(n, 9)``: direction, value, ``dvcm``, ``dvc``, depth.
        starts: first photon of each cell.
        cells: number of cells, a power of 2.
        scales: radius, and factor of values.
    """
    radius, scale = item(scales, 0), item(scales, 1)
    inverse = np.float32(0.5) / radius
    sums, kept = carray(stack_memory(KEPT, np.float64), (KEPT,)), carray(stack_memory(KEPT, np.int64), (KEPT,))
    numbers, begins, ends = (
        stack_memory(CORNERS, np.int64),
        stack_memory(CORNERS, np.int64),
        stack_memory(CORNERS, np.int64),
    )
    place = stack_memory(COORDINATES, np.float32)
    o, d, t = item(rows, 0) * stride, item(rows, 1) * stride, item(rows, 2) * stride
    key, key_rows, found = item(rows, 3) * stride, np.int64(item(rows, 4)), item(rows, 5) * stride
    for start in range(0, count, GROUP):
        group = min(GROUP, count - start)
        for number in range(group):
            lane = np.int64(item(lanes, start + number))
            distance = item(floats, t + lane)
            x = item(floats, o + lane) + item(floats, d + lane) * distance
            y = item(floats, o + stride + lane) + item(floats, d + stride + lane) * distance
            z = item(floats, o + 2 * stride + lane) + item(floats, d + 2 * stride + lane) * distance
            put(place, 3 * number, x)
            put(place, 3 * number + 1, y)
            put(place, 3 * number + 2, z)
            _find_cells(starts, cells, x, y, z, radius, inverse, numbers, 8 * number)
        for number in range(group):
            _find_photons(points, size, starts, numbers, begins, ends, 8 * number)
        for number in range(group):
            lane, first = np.int64(item(lanes, start + number)), 8 * number
            x, y, z = item(place, 3 * number), item(place, 3 * number + 1), item(place, 3 * number + 2)
            total, chosen, visited = _scan(points, size, x, y, z, radius, math.inf, sums, kept, begins, ends, first)
            if not total > 0.0:
                put(begins, first, -1)
                continue
            hashed = np.uint32(salt & 0xFFFFFFFF)
            for row in range(key_rows):
                hashed = _mix(
                    np.uint32(hashed ^ np.uint32(np.int64(item(words, key + row * stride + lane)) & 0xFFFFFFFF))
                )
            part = np.float64(np.int64(hashed)) * (total / 4294967296.0)
            if visited > KEPT:
                _, chosen, _ = _scan(points, size, x, y, z, radius, part, sums, kept, begins, ends, first)
            else:
                for k in range(visited):
                    if sums[k] > part:
                        chosen = kept[k]
                        break
            put(begins, first, chosen)
            put(place, 3 * number, np.float32(total / np.float64(item(points, 3 * size + chosen))) * scale)
            prefetch(data, ROWS * chosen)
            prefetch(data, ROWS * chosen + ROWS - 1)
        for number in range(group):
            lane, chosen, factor = (
                np.int64(item(lanes, start + number)),
                item(begins, 8 * number),
                item(place, 3 * number),
            )
            for row in range(ROWS):
                value = np.float32(0.0)
                if chosen >= 0:
                    value = item(data, ROWS * chosen + row) * (factor if VALUE <= row < VALUE + 3 else np.float32(1.0))
                put(floats, found + row * stride + lane, value)
