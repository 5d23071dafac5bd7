"""Refit a wide tree to primitives that have moved: the same nodes, leaves and ids, with new boxes and triangles.

``tree`` is the buffer of the new tree as float32 and ``codes`` the same memory as int32; ``before`` and ``old`` are those of
the tree that is refitted. ``at`` is an offset in a buffer. The layout is explained in :mod:`torchpt.search.tree_layout`.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import INT, array, inner, kernel
from kernel_sources.simd import (
    bits,
    gather,
    highest,
    item,
    load,
    lowest,
    popcount,
    put,
    select,
    splat,
    stack_memory,
    store,
    trailing_zeros,
    widen,
)
from kernel_sources.tree_build import boxes_of, planes_of
from kernel_sources.tree_nodes import block_offset
from torchpt.search.tree_layout import CHILDREN, IDS, LEAF, LINE, MORE, NODE, PLANES, RECTANGLES, RULED

__all__ = ["refit"]

_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@inner(forceinline=True)
def _moved(tree, at, p, ids, here):
    """Copy corners ``p (3, P)`` of a leaf's triangles to the tree, NaN where the mask ``here`` is not set; return float64."""
    n, none = np.int32(p.shape[1]), splat(_NAN, 8)
    x = gather(p, ids, here, none)
    y = gather(p, ids + splat(n, 8), here, none)
    z = gather(p, ids + splat(np.int32(2 * n), 8), here, none)
    store(tree, at, x)
    store(tree, at + 8, y)
    store(tree, at + 16, z)
    return widen(x), widen(y), widen(z)


@inner(forceinline=True)
def _half_area(tree, at):
    """Return half the area of the box whose six numbers begin at ``at``, eight apart; 0 for an empty box."""
    x = np.float64(item(tree, at + 24)) - np.float64(item(tree, at))
    y = np.float64(item(tree, at + 32)) - np.float64(item(tree, at + 8))
    z = np.float64(item(tree, at + 40)) - np.float64(item(tree, at + 16))
    return x * y + y * z + z * x if x >= 0.0 and y >= 0.0 and z >= 0.0 else 0.0


@inner(forceinline=True)
def _union(boxes, first, out, at):
    """Write the bounding box of the eight boxes from ``first`` on to ``out`` at ``at``, in the layout of a node."""
    for j in range(0, 24, 8):
        put(out, at + j, lowest(load(boxes, first + j, 8)))
        put(out, at + 24 + j, highest(load(boxes, first + 24 + j, 8)))


@inner()
def _leaf(at, old, tree, codes, p0, p1, p2, triangles, non_triangles, boxes):
    """Write the block of a leaf; ``boxes`` ``(48,)`` gets low x, y, z, high x, y, z of its primitives."""
    ids, none = load(old, at + IDS, 8), splat(_NAN, 8)
    store(codes, at + IDS, ids)
    here = ids >= splat(np.int32(0), 8)
    a, b, c = (
        _moved(tree, at, p0, ids, here),
        _moved(tree, at + 24, p1, ids, here),
        _moved(tree, at + 48, p2, ids, here),
    )
    n0, n1, n2, d, good = planes_of(a, b, c)
    # A triangle without area gets NaN, which no ray hits; its id stays for the next refit.
    store(tree, at + PLANES, select(good, n0, none))
    store(tree, at + PLANES + 8, select(good, n1, none))
    store(tree, at + PLANES + 16, select(good, n2, none))
    store(tree, at + PLANES + 24, select(good, d, none))
    if bits(good) != bits(here):
        for j in range(0, 72, 8):
            store(tree, at + j, select(good, load(tree, at + j, 8), none))
    x0, y0, z0, x1, y1, z1 = boxes_of(a, b, c)
    low, high = splat(_INF, 8), splat(-_INF, 8)
    store(boxes, 0, select(good, x0, low))
    store(boxes, 8, select(good, y0, low))
    store(boxes, 16, select(good, z0, low))
    store(boxes, 24, select(good, x1, high))
    store(boxes, 32, select(good, y1, high))
    store(boxes, 40, select(good, z1, high))
    mixed = bits(ids < splat(np.int32(-1), 8))
    while mixed != 0:
        k = trailing_zeros(mixed)
        mixed &= mixed - 1
        for j in range(6):
            put(boxes, j * 8 + k, non_triangles[-2 - item(old, at + IDS + k) - triangles, j])


@inner()
def _rectangles(at, before, old, tree, corner, rows, triangles, disk):
    """Write the rectangles of a leaf; unused entries stay NaN."""
    for j in range(RECTANGLES, RECTANGLES + MORE * LINE):
        put(tree, at + j, item(before, at + j))
    for k in range(8):
        q = -2 - item(old, at + IDS + k)
        if triangles <= q < disk:
            for c in range(12):
                put(tree, at + RECTANGLES + c * 8 + k, corner[q - triangles, c])
            for c in range(4):
                put(tree, at + RECTANGLES + RULED + c * 8 + k, rows[q - triangles, c])


@kernel(
    "tree_refit",
    array("f4"),
    array("i4"),
    INT,
    INT,
    *(array("f4", 2),) * 3,
    INT,
    INT,
    *(array("f4", 2),) * 3,
    array("f4"),
    array("i4"),
    array("i8"),
    array("f8"),
)
def refit(
    before, old, line, nodes, p0, p1, p2, triangles, disk, corner, rows, non_triangles, tree, codes, lines, costs
):
    """Fill the blocks of a tree with the topology of another tree, which is not changed.

    In the buffer children must follow their parents, and the leaves of a node must follow it at once.

    Args:
        before: the other tree's buffer, float32.
        old: the same memory as int32.
        line: line of both buffers at which the root begins.
        nodes: number of nodes.
        p0: ``(3, P)`` float32 corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        triangles: number of triangles among the P primitives; they come first.
        disk: id of the first primitive that is neither triangle nor rectangle.
        corner: ``(P - triangles, 12)`` corners of the other primitives.
        rows: ``(P - triangles, 12)`` affine rows of the other primitives.
        non_triangles: ``(P - triangles, 6)`` float32 boxes of the other primitives: low x, y, z, high x, y, z.
        tree: float32, as long as ``before``, filled.
        codes: the same memory as int32.
        lines: ``(nodes,)`` int64 scratch memory.
        costs: ``(2,)`` float64, filled: expected cost of a random ray through the root's box, 1 a node and 1 a leaf: of the
            other tree, and of this one.
    """
    boxes = stack_memory(48, np.float32)
    first, root = np.int64(0), np.int64(line) * LINE
    for node in range(nodes):
        lines[node] = line
        children, none = load(old, line * LINE + CHILDREN, 8), splat(np.int32(0), 8)
        leaves = bits(children < none)
        ruled = leaves & bits((children & splat(np.int32(2), 8)) == none)
        line += NODE + LEAF * popcount(leaves) + MORE * popcount(ruled)
    work, work_before = 0.0, 0.0
    for node in range(nodes - 1, -1, -1):
        base = lines[node] * LINE
        store(codes, base + CHILDREN, load(old, base + CHILDREN, 16))
        for k in range(8):
            code, at = np.int64(item(old, base + CHILDREN + k)), base + k
            if code > 0:
                _union(tree, block_offset(code), tree, at)
            elif code < 0:
                _leaf(block_offset(code), old, tree, codes, p0, p1, p2, triangles, non_triangles, boxes)
                if code & 2 == 0:
                    _rectangles(block_offset(code), before, old, tree, corner, rows, triangles, disk)
                _union(boxes, first, tree, at)
            else:  # an empty box, which no ray hits
                for j in range(0, 24, 8):
                    put(tree, at + j, _INF)
                    put(tree, at + 24 + j, -_INF)
            work += _half_area(tree, at)
            work_before += _half_area(before, at)
    _union(tree, root, boxes, first)
    work /= _half_area(boxes, first)
    _union(before, root, boxes, first)
    costs[0], costs[1] = 1.0 + work_before / _half_area(boxes, first), 1.0 + work
