"""From a binary tree to the wide one that rays are expected to search at the least cost (numba).

By dynamic programming over the binary tree, as in section 3.1 of Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal
on GPUs Through Compressed Wide BVHs" (2017): what is below a node becomes a leaf, a wide node, or up to seven of its
parent's children, whichever costs least by the surface area heuristic.
"""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_build import WIDTH, half_area
from torchpt.native.jit import jit

__all__ = ["choose", "collapse"]

_INF, _ZERO = np.float32(np.inf), np.float32(0.0)
#: Cost of a leaf's test of eight triangles, of its rectangles beside, and of each other primitive; a wide node costs 1.
_TRIANGLES, _RECTANGLES, _OTHER = np.float32(1.0), np.float32(1.3), np.float32(2.0)


@jit()
def _leaf_cost(ids, start, stop, rectangle, other):
    ruled, more = False, _ZERO
    for i in range(start, stop):
        ruled = ruled or rectangle <= ids[i] < other
        more += _OTHER if ids[i] >= other else _ZERO
    return _TRIANGLES + more + (_RECTANGLES if ruled else _ZERO)


@jit()
def choose(nodes, spans, ids, rectangle, other, cost, share):
    """Finds what is best done with each node of a binary tree.

    Args:
        nodes: boxes ``(M, 6)`` float32.
        spans: ``(M, 3)`` int32: first primitive, one past the last, first child (0 for none).
        ids: ``(L,)`` primitives in the tree's order.
        rectangle: id of the first primitive that is no triangle.
        other: id of the first one that is no rectangle either.
        cost: ``(M, WIDTH)`` float32, filled: of what is below a node as at most 1, 2, ... children.
        share: ``(M, WIDTH)`` int8, filled: how many of as many children go to the node's first child; 0 where fewer do as well.
            As one child it is a leaf (0), or a wide node that hands so many of its eight to its first child.
    """
    for node in range(len(nodes) - 1, -1, -1):  # children come after their parents
        start, stop, left = spans[node, 0], spans[node, 1], spans[node, 2]
        area = half_area(nodes, node)
        leaf = area * _leaf_cost(ids, start, stop, rectangle, other) if stop - start <= WIDTH else _INF
        cost[node, :] = leaf
        share[node, :] = 0
        if left == 0:
            continue
        for k in range(1, WIDTH):
            best, pick = _INF, 1
            for i in range(k):
                both = cost[left, i] + cost[left + 1, k - 1 - i]
                if both < best:
                    best, pick = both, i + 1
            cost[node, k], share[node, k] = best, pick
        wide = cost[node, WIDTH - 1] + area
        if wide < leaf or stop - start > WIDTH:
            cost[node, 0], share[node, 0] = wide, share[node, WIDTH - 1]
        for k in range(1, WIDTH):
            if cost[node, k - 1] <= cost[node, k]:
                cost[node, k], share[node, k] = cost[node, k - 1], 0


@jit()
def _children(root, spans, share, slots, nodes, room):
    """Fills ``slots`` with what the children of a wide node are in the binary tree; returns how many there are."""
    count, top, first = 0, 2, share[root, 0]
    left = spans[root, 2]
    nodes[0], room[0], nodes[1], room[1] = left + 1, WIDTH - first, left, first
    while top > 0:
        top -= 1
        node, k = nodes[top], room[top] - 1
        while k > 0 and share[node, k] == 0:
            k -= 1
        if k == 0:
            slots[count] = node
            count += 1
        else:
            left, first = spans[node, 2], share[node, k]
            nodes[top], room[top], nodes[top + 1], room[top + 1] = left + 1, k + 1 - first, left, first
            top += 2
    return count


@jit()
def collapse(nodes, spans, share, boxes, child, first):
    """Writes down the wide tree that :func:`choose` found.

    Args:
        nodes: boxes of the binary tree.
        spans: its topology.
        share: what is done with its nodes.
        boxes: ``(M * 48,)`` float32, filled: per node low x, y, z, high x, y, z of 8 children; empty ones at infinity.
        child: ``(M * 8,)`` int32, filled: a node, or ``~leaf``.
        first: ``(K, 2)`` int32, filled: the primitives of each leaf.

    Returns:
        Nodes, leaves and depth.
    """
    pending = np.empty((len(child) // WIDTH + 1, 2), np.int32)  # binary node and depth of each wide node
    pending[0, 0], pending[0, 1] = 0, 1
    slots, stack, room = np.empty(WIDTH, np.int32), np.empty(2 * WIDTH, np.int32), np.empty(2 * WIDTH, np.int32)
    used, leaves, depth, wide = 1, 0, 1, 0
    while wide < used:
        root, level = pending[wide, 0], pending[wide, 1]
        depth = max(depth, level)
        if share[root, 0] == 0:  # the whole tree is one leaf
            slots[0], n = root, 1
        else:
            n = _children(root, spans, share, slots, stack, room)
        for k in range(WIDTH):
            for c in range(6):
                boxes[wide * 6 * WIDTH + c * WIDTH + k] = nodes[slots[k], c] if k < n else _INF
            code = np.int32(0)
            if k < n and share[slots[k], 0] > 0:
                code = np.int32(used)
                pending[used, 0], pending[used, 1] = slots[k], level + 1
                used += 1
            elif k < n:
                code = np.int32(~leaves)
                first[leaves, 0], first[leaves, 1] = spans[slots[k], 0], spans[slots[k], 1]
                leaves += 1
            child[wide * WIDTH + k] = code
        wide += 1
    return used, leaves, depth
