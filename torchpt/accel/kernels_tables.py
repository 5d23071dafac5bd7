"""What the tree needs of triangles (numba): the float64 operations of ``tables.prepare`` and ``bounds`` in one pass.

Eight triangles go together, as vectors of float64.
"""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit, part
from torchpt.native.simd import (
    absolute,
    as_float,
    as_int,
    bits,
    lane_numbers,
    load_masked,
    maximum,
    minimum,
    narrow,
    select,
    splat,
    square_root,
    store,
    trailing_zeros,
    widen,
)

__all__ = ["boxes_of", "leaf_ids", "planes_of", "triangle_tables"]

_MARGIN = 2.0**-22
_ZERO = np.float32(0.0)


@part(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part(forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part(forceinline=True)
def _finite(row, p):
    """Whether affine rows about points are finite in float32."""
    total, zero = narrow(row[0]) + narrow(row[1]) + narrow(row[2]) + narrow(-_dot(row, p)), splat(_ZERO, 8)
    return total * zero == zero


@part(forceinline=True)
def planes_of(a, b, c):
    """Unit normals and distances of eight triangles by float64 corners, and which can be hit.

    See :func:`torchpt.accel.tables.prepare`. The numbers of those that cannot mean nothing.
    """
    e1 = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    e2 = (c[0] - a[0], c[1] - a[1], c[2] - a[2])
    cross = _cross(e1, e2)
    length = square_root(_dot(cross, cross))
    n = (cross[0] / length, cross[1] / length, cross[2] / length)
    u, v = _cross(e2, n), _cross(n, e1)
    u, v = (u[0] / length, u[1] / length, u[2] / length), (v[0] / length, v[1] / length, v[2] / length)
    good = (length > splat(0.0, 8)) & _finite(n, a) & _finite(u, a) & _finite(v, a)
    return narrow(n[0]), narrow(n[1]), narrow(n[2]), narrow(-_dot(n, a)), good


@part(forceinline=True)
def _down(x):
    """The float32 below float64 lanes, or their own."""
    near, one = narrow(x), splat(np.int32(1), 8)
    whole, zero = as_int(near), splat(np.int32(0), 8)
    # the next float32: one less in its bits, one more where they are those of a negative number
    below = select(whole < zero, whole + one, whole - one)
    below = select(near == splat(_ZERO, 8), splat(np.int32(-(2**31) + 1), 8), below)
    return select(widen(near) > x, as_float(below), near)


@part(forceinline=True)
def _span(a, b, c):
    return minimum(minimum(a, b), c), maximum(maximum(a, b), c)


@part(forceinline=True)
def boxes_of(a, b, c):
    """Boxes of eight triangles with their margin: low x, y, z, high x, y, z.

    See :func:`torchpt.accel.bounds.primitive_bounds`.
    """
    x0, x1 = _span(a[0], b[0], c[0])
    y0, y1 = _span(a[1], b[1], c[1])
    z0, z1 = _span(a[2], b[2], c[2])
    size, share = maximum(maximum(x1 - x0, y1 - y0), z1 - z0), splat(_MARGIN, 8)
    x = share * (maximum(absolute(x0), absolute(x1)) + size)
    y = share * (maximum(absolute(y0), absolute(y1)) + size)
    z = share * (maximum(absolute(z0), absolute(z1)) + size)
    return _down(x0 - x), _down(y0 - y), _down(z0 - z), -_down(-(x1 + x)), -_down(-(y1 + y)), -_down(-(z1 + z))


@part(forceinline=True)
def _corner(p, i, some):
    """Corners of the triangles from ``i`` on, where the mask is set."""
    n, none = p.shape[1], splat(_ZERO, 8)
    x, y, z = (
        load_masked(p, i, some, none),
        load_masked(p, n + i, some, none),
        load_masked(p, 2 * n + i, some, none),
    )
    return widen(x), widen(y), widen(z)


@jit()
def triangle_tables(p0, p1, p2, count, planes, boxes, ids):
    """Planes of the first ``count`` primitives, and boxes of those that can be hit.

    Args:
        p0: ``(3, P)`` float32 corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        count: how many of the primitives are triangles.
        planes: ``(count, 4)`` float32, filled: unit normal and distance; zeros where a triangle has no area.
        boxes: ``(count, 6)`` float32, filled from the front.
        ids: ``(count,)`` int32, filled alike.

    Returns:
        How many can be hit.
    """
    kept = 0
    row, box, none = np.empty(32, np.float32), np.empty(48, np.float32), splat(_ZERO, 8)
    for i in range(0, count, 8):
        some = lane_numbers(8) < splat(np.int32(min(count - i, 8)), 8)
        a, b, c = _corner(p0, i, some), _corner(p1, i, some), _corner(p2, i, some)
        n0, n1, n2, d, good = planes_of(a, b, c)
        store(row, 0, select(good, n0, none))
        store(row, 8, select(good, n1, none))
        store(row, 16, select(good, n2, none))
        store(row, 24, select(good, d, none))
        x0, y0, z0, x1, y1, z1 = boxes_of(a, b, c)
        store(box, 0, x0)
        store(box, 8, y0)
        store(box, 16, z0)
        store(box, 24, x1)
        store(box, 32, y1)
        store(box, 40, z1)
        for k in range(min(count - i, 8)):
            for j in range(4):
                planes[i + k, j] = row[j * 8 + k]
        left = bits(good)
        while left != 0:
            k = trailing_zeros(left)
            left &= left - 1
            for j in range(6):
                boxes[kept, j] = box[j * 8 + k]
            ids[kept] = i + k
            kept += 1
    return kept


@jit()
def leaf_ids(first, ids, slots):
    """Fills ``slots (L, 8)`` with the primitives of leaves that span ``first (L, 2)`` of ``ids``, rising, -1 after them."""
    for leaf in range(len(first)):
        start, count = first[leaf, 0], first[leaf, 1] - first[leaf, 0]
        for k in range(8):
            slots[leaf, k] = -1
        for k in range(count):
            q, j = ids[start + k], k
            while j > 0 and slots[leaf, j - 1] > q:
                slots[leaf, j] = slots[leaf, j - 1]
                j -= 1
            slots[leaf, j] = q
