"""From a tree of boxes to blocks of cache lines (numba)."""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import CHILDREN, IDS, LEAF, LINE, NODE, PLANES
from torchpt.native.jit import jit, part

__all__ = ["lay_out"]

_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@part()
def _leaf(base, tree, codes, ids, first, p0, p1, p2, planes, triangles):
    """Writes a leaf's block; returns 1 where it holds more than triangles."""
    mixed = 0
    for k in range(8):
        q = ids[first + k]
        if q >= triangles:
            mixed = 1
            codes[base + IDS + k] = -2 - q
        else:
            codes[base + IDS + k] = q
        here = 0 <= q < triangles
        for c in range(3):
            tree[base + c * 8 + k] = p0[c, q] if here else _NAN
            tree[base + (3 + c) * 8 + k] = p1[c, q] if here else _NAN
            tree[base + (6 + c) * 8 + k] = p2[c, q] if here else _NAN
        for c in range(4):
            tree[base + PLANES + c * 8 + k] = planes[q, c] if here else _NAN
    return mixed


@jit()
def lay_out(boxes, child, ids, p0, p1, p2, planes, triangles, line, tree, codes):
    """Fills the blocks of a tree, parents before children, each node's leaves right behind it.

    Args:
        boxes: ``(M * 48,)`` float32: low x, y, z, high x, y, z of eight children a node; infinite where there is none.
        child: ``(M * 8,)`` int32: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)`` int32 primitives of the leaves in rising order, -1 where there is none.
        p0: ``(3, P)`` corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        planes: ``(T, 4)`` of the triangles.
        triangles: how many of the P are triangles; these come first.
        line: the line of ``tree`` at which the root goes.
        tree: float32, filled: ``4 M + 7 L`` lines.
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
                next_line += LEAF
    for node in range(len(lines)):
        base, leaf = lines[node] * LINE, lines[node] + NODE
        for k in range(8):
            code = child[node * 8 + k]
            for c in range(6):
                x = boxes[node * 48 + c * 8 + k]
                # a box that ends before it begins is met by no ray
                tree[base + c * 8 + k] = -_INF if code == 0 and c >= 3 else x
            codes[base + CHILDREN + k] = 2 * lines[code] if code > 0 else 0
            if code < 0:
                mixed = _leaf(leaf * LINE, tree, codes, ids, (~code) * 8, p0, p1, p2, planes, triangles)
                codes[base + CHILDREN + k] = ~(2 * leaf + mixed)
                leaf += LEAF
            codes[base + CHILDREN + 8 + k] = 0
