"""From a tree of boxes to blocks of cache lines (numba)."""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import CHILDREN, IDS, LEAF, LINE, MORE, NODE, PLANES
from torchpt.accel.kernels_others import RECTANGLES, RULED
from torchpt.native.jit import jit, part

__all__ = ["lay_out"]

_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@part()
def _kinds(ids, first, triangles, disk):
    """2 for a leaf that holds rectangles, plus 1 for one that holds other primitives beside triangles."""
    found = 0
    for k in range(8):
        q = ids[first + k]
        if q >= disk:
            found |= 1
        elif q >= triangles:
            found |= 2
    return found


@part()
def _leaf(base, tree, codes, ids, first, p0, p1, p2, planes, triangles):
    """Writes a leaf's triangles and ids."""
    for k in range(8):
        q = ids[first + k]
        codes[base + IDS + k] = -2 - q if q >= triangles else q
        here = 0 <= q < triangles
        for c in range(3):
            tree[base + c * 8 + k] = p0[c, q] if here else _NAN
            tree[base + (3 + c) * 8 + k] = p1[c, q] if here else _NAN
            tree[base + (6 + c) * 8 + k] = p2[c, q] if here else _NAN
        for c in range(4):
            tree[base + PLANES + c * 8 + k] = planes[q, c] if here else _NAN


@part()
def _rectangles(base, tree, ids, first, corner, rows, triangles, disk):
    """Writes a leaf's rectangles."""
    for k in range(8):
        q = ids[first + k]
        here = triangles <= q < disk
        for c in range(12):
            tree[base + RECTANGLES + c * 8 + k] = corner[q - triangles, c] if here else _NAN
        for c in range(4):
            tree[base + RECTANGLES + RULED + c * 8 + k] = rows[q - triangles, c] if here else _NAN


@jit()
def lay_out(boxes, child, ids, p0, p1, p2, planes, corner, rows, triangles, disk, line, tree, codes):
    """Fills the blocks of a tree, parents before children, each node's leaves right behind it.

    Args:
        boxes: ``(M * 48,)`` float32: low x, y, z, high x, y, z of eight children a node; infinite where there is none.
        child: ``(M * 8,)`` int32: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)`` int32 primitives of the leaves in rising order, -1 where there is none.
        p0: ``(3, P)`` corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        planes: ``(T, 4)`` of the triangles.
        corner: ``(K, 12)`` corners of the other primitives.
        rows: ``(K, 12)`` their affine rows.
        triangles: how many of the P are triangles; these come first.
        disk: id of the first primitive that is neither triangle nor rectangle.
        line: the line of ``tree`` at which the root goes.
        tree: float32, filled: ``4 M + 7 L`` lines, and 8 for each leaf that holds rectangles.
        codes: the same memory as int32.
    """
    lines = np.empty(len(child) // 8, np.int64)
    stack = np.empty(len(child) + 8, np.int32)
    stack[0], top, next_line = 0, 1, np.int64(line)
    while top > 0:
        top -= 1
        node = stack[top]
        lines[node] = next_line
        next_line += NODE
        for k in range(7, -1, -1):
            code = child[node * 8 + k]
            if code > 0:
                stack[top] = code
                top += 1
            elif code < 0:
                next_line += LEAF + (MORE if _kinds(ids, (~code) * 8, triangles, disk) & 2 else 0)
    for node in range(len(lines)):
        base, leaf = lines[node] * LINE, lines[node] + NODE
        for k in range(8):
            code = child[node * 8 + k]
            for c in range(6):
                x = boxes[node * 48 + c * 8 + k]
                # a box that ends before it begins is met by no ray
                tree[base + c * 8 + k] = -_INF if code == 0 and c >= 3 else x
            codes[base + CHILDREN + k] = 4 * lines[code] if code > 0 else 0
            if code < 0:
                first = (~code) * 8
                kinds = _kinds(ids, first, triangles, disk)
                _leaf(leaf * LINE, tree, codes, ids, first, p0, p1, p2, planes, triangles)
                codes[base + CHILDREN + k] = ~(4 * leaf + kinds)
                leaf += LEAF
                if kinds & 2:
                    _rectangles((leaf - LEAF) * LINE, tree, ids, first, corner, rows, triangles, disk)
                    leaf += MORE
            codes[base + CHILDREN + 8 + k] = 0
