"""Build of the wide tree (numba): binned SAH to a binary tree, then collapse to eight children a node."""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit

__all__ = ["WIDTH", "build_binary", "collapse"]

#: Children a node, and primitives a leaf: one vector of boxes or triangles.
WIDTH = 8
_BINS = 16
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)


@jit(forceinline=True)
def _half_area(b, k):
    x, y, z = b[k, 3] - b[k, 0], b[k, 4] - b[k, 1], b[k, 5] - b[k, 2]
    return x * y + y * z + z * x


@jit(forceinline=True)
def _clear(b, k):
    for c in range(3):
        b[k, c] = _INF
        b[k, 3 + c] = -_INF


@jit(forceinline=True)
def _grow(b, k, x, i):
    for c in range(3):
        b[k, c] = min(b[k, c], x[i, c])
        b[k, 3 + c] = max(b[k, 3 + c], x[i, 3 + c])


@jit(forceinline=True)
def _bin(box, i, axis, low, scale):
    k = int((box[i, axis] + box[i, 3 + axis] - low) * scale)
    return min(max(k, 0), _BINS - 1)


@jit()
def _best_split(box, start, stop, low, scale, bins, counts, suffix):
    """Cheapest plane by the surface area heuristic (Wald 2007): axis, first bin of the upper side, cost (or -1)."""
    counts[:] = 0
    for k in range(3 * _BINS):
        _clear(bins, k)
    for i in range(start, stop):
        for axis in range(3):
            k = axis * _BINS + _bin(box, i, axis, low[axis], scale[axis])
            counts[k] += 1
            _grow(bins, k, box, i)
    best, best_axis, best_cut = np.float64(np.inf), -1, 0
    for axis in range(3):
        if scale[axis] == _ZERO:
            continue
        base = axis * _BINS
        _clear(bins, 3 * _BINS)
        n = 0
        for k in range(_BINS - 1, 0, -1):
            n += counts[base + k]
            _grow(bins, 3 * _BINS, bins, base + k)
            suffix[k] = np.float64(_half_area(bins, 3 * _BINS)) * n if n > 0 else 0.0
        _clear(bins, 3 * _BINS)
        n = 0
        for k in range(1, _BINS):
            n += counts[base + k - 1]
            _grow(bins, 3 * _BINS, bins, base + k - 1)
            if 0 < n < stop - start:
                cost = np.float64(_half_area(bins, 3 * _BINS)) * n + suffix[k]
                if cost < best:
                    best, best_axis, best_cut = cost, axis, k
    return best_axis, best_cut, best


@jit()
def _partition(box, ids, start, stop, axis, cut, low, scale):
    """Moves the primitives of the lower bins to the front; returns where the upper side starts."""
    i, j = start, stop - 1
    while i <= j:
        if _bin(box, i, axis, low, scale) < cut:
            i += 1
        else:
            for c in range(6):
                box[i, c], box[j, c] = box[j, c], box[i, c]
            ids[i], ids[j] = ids[j], ids[i]
            j -= 1
    return i


@jit()
def build_binary(box, ids, nodes, spans, leaf_size):
    """Binary tree over primitives.

    Args:
        box: ``(L, 6)`` float32 boxes; permuted in place.
        ids: ``(L,)`` int32; permuted alike.
        nodes: ``(2 L, 6)`` float32, filled with boxes.
        spans: ``(2 L, 3)`` int32, filled: first primitive, one past the last, first child (0 for a leaf; the second
            child follows it).
        leaf_size: most primitives a leaf.

    Returns:
        How many nodes there are; node 0 is the root.
    """
    bins = np.empty((3 * _BINS + 1, 6), np.float32)
    counts = np.empty(3 * _BINS, np.int64)
    suffix = np.empty(_BINS, np.float64)
    low, high, scale = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    spans[0, 0], spans[0, 1], spans[0, 2] = 0, len(ids), 0
    used = 1
    node = 0
    while node < used:  # breadth first: the queue is the tree itself
        start, stop = spans[node, 0], spans[node, 1]
        _clear(nodes, node)
        low[:] = _INF
        high[:] = -_INF
        for i in range(start, stop):
            _grow(nodes, node, box, i)
            for c in range(3):
                centre = box[i, c] + box[i, 3 + c]
                low[c] = min(low[c], centre)
                high[c] = max(high[c], centre)
        if stop - start > leaf_size:
            for c in range(3):
                size = high[c] - low[c]
                scale[c] = np.float32(_BINS) / size if size > _ZERO else _ZERO
                if not scale[c] < _INF:
                    scale[c] = _ZERO
            axis, cut, _ = _best_split(box, start, stop, low, scale, bins, counts, suffix)
            middle = (start + stop) // 2
            if axis >= 0:
                middle = _partition(box, ids, start, stop, axis, cut, low[axis], scale[axis])
            spans[node, 2] = used
            for child in range(2):
                spans[used + child, 0] = start if child == 0 else middle
                spans[used + child, 1] = middle if child == 0 else stop
                spans[used + child, 2] = 0
            used += 2
        node += 1
    return used


@jit()
def collapse(nodes, spans, boxes, child, first):
    """Opens the binary tree's largest children until each node has eight.

    Args:
        nodes: boxes of the binary tree.
        spans: its topology.
        boxes: ``(M * 48,)`` float32, filled: per node low x, y, z, high x, y, z of 8 children; empty ones at infinity.
        child: ``(M * 8,)`` int32, filled: a node, or ``~leaf``.
        first: ``(K, 2)`` int32, filled: the primitives of each leaf.

    Returns:
        Nodes, leaves and depth.
    """
    pending = np.empty((len(child) // WIDTH + 1, 2), np.int32)  # binary node and depth of each wide node
    pending[0, 0], pending[0, 1] = 0, 1
    slots = np.empty(WIDTH, np.int32)
    used, leaves, depth, wide = 1, 0, 1, 0
    while wide < used:
        slots[0] = pending[wide, 0]
        level = pending[wide, 1]
        depth = max(depth, level)
        n = 1
        while n < WIDTH:
            best, pick = np.float32(-1.0), -1
            for k in range(n):
                if spans[slots[k], 2] > 0:
                    area = _half_area(nodes, slots[k])
                    if area > best:
                        best, pick = area, k
            if pick < 0:
                break
            opened = spans[slots[pick], 2]
            slots[pick], slots[n] = opened, opened + 1
            n += 1
        for k in range(WIDTH):
            for c in range(6):
                boxes[wide * 6 * WIDTH + c * WIDTH + k] = nodes[slots[k], c] if k < n else _INF
            code = np.int32(0)
            if k < n and spans[slots[k], 2] > 0:
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
