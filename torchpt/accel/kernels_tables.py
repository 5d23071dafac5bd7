"""What the tree needs of triangles (numba): the float64 operations of ``tables.prepare`` and ``bounds`` in one pass."""

from __future__ import annotations

import math

import numpy as np

from torchpt.native.jit import jit, part

__all__ = ["leaf_ids", "triangle_tables", "work"]

_MARGIN = 2.0**-22
_INF32 = np.float32(np.inf)


@part(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@part(forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@part(forceinline=True)
def _finite(row, p):
    """Whether an affine row about a point is finite in float32."""
    total = np.float32(row[0]) + np.float32(row[1]) + np.float32(row[2]) + np.float32(-_dot(row, p))
    return total * np.float32(0.0) == np.float32(0.0)


@part()
def _plane(a, b, c, planes, i):
    """Writes the plane of a triangle; returns whether it can be hit, see :func:`torchpt.accel.tables.prepare`."""
    e1 = (b[0] - a[0], b[1] - a[1], b[2] - a[2])
    e2 = (c[0] - a[0], c[1] - a[1], c[2] - a[2])
    cross = _cross(e1, e2)
    length = math.sqrt(_dot(cross, cross))
    n = (cross[0] / length, cross[1] / length, cross[2] / length)
    u, v = _cross(e2, n), _cross(n, e1)
    u, v = (u[0] / length, u[1] / length, u[2] / length), (v[0] / length, v[1] / length, v[2] / length)
    good = length > 0.0 and _finite(n, a) and _finite(u, a) and _finite(v, a)
    for k in range(3):
        planes[i, k] = n[k] if good else 0.0
    planes[i, 3] = -_dot(n, a) if good else 0.0
    return good


@part()
def _box(a, b, c, boxes, i):
    """Writes the box of a triangle with its margin, see :func:`torchpt.accel.bounds.primitive_bounds`."""
    size = 0.0
    for k in range(3):
        size = max(size, max(max(a[k], b[k]), c[k]) - min(min(a[k], b[k]), c[k]))
    for k in range(3):
        low, high = min(min(a[k], b[k]), c[k]), max(max(a[k], b[k]), c[k])
        margin = _MARGIN * (max(abs(low), abs(high)) + size)
        low, high = low - margin, high + margin
        down, up = np.float32(low), np.float32(high)
        boxes[i, k] = np.nextafter(down, -_INF32) if np.float64(down) > low else down
        boxes[i, 3 + k] = np.nextafter(up, _INF32) if np.float64(up) < high else up


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
    for i in range(count):
        a = (np.float64(p0[0, i]), np.float64(p0[1, i]), np.float64(p0[2, i]))
        b = (np.float64(p1[0, i]), np.float64(p1[1, i]), np.float64(p1[2, i]))
        c = (np.float64(p2[0, i]), np.float64(p2[1, i]), np.float64(p2[2, i]))
        if _plane(a, b, c, planes, i):
            _box(a, b, c, boxes, kept)
            ids[kept] = i
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


@jit()
def work(nodes, spans):
    """Sum over a binary tree's nodes of half their box's area times 1, or times the primitives of a leaf."""
    total = 0.0
    for k in range(len(nodes)):
        x = np.float64(nodes[k, 3]) - np.float64(nodes[k, 0])
        y = np.float64(nodes[k, 4]) - np.float64(nodes[k, 1])
        z = np.float64(nodes[k, 5]) - np.float64(nodes[k, 2])
        steps = 1.0 if spans[k, 2] > 0 else np.float64(spans[k, 1] - spans[k, 0])
        total += (x * y + y * z + z * x) * steps
    return total
