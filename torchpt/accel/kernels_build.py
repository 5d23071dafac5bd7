"""Binary trees by the surface area heuristic (numba): binned (Wald 2007), and exact over the last few primitives."""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit

__all__ = ["WIDTH", "build_binary", "half_area"]

#: Children a node, and primitives a leaf: one vector of boxes or triangles.
WIDTH = 8
_BINS = 16
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)


@jit(forceinline=True)
def half_area(b, k):
    """Half the surface of a box."""
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
    """Cheapest plane by the surface area heuristic (Wald 2007): axis (-1: none), first bin of the upper side."""
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
            suffix[k] = np.float64(half_area(bins, 3 * _BINS)) * n if n > 0 else 0.0
        _clear(bins, 3 * _BINS)
        n = 0
        for k in range(1, _BINS):
            n += counts[base + k - 1]
            _grow(bins, 3 * _BINS, bins, base + k - 1)
            if 0 < n < stop - start:
                cost = np.float64(half_area(bins, 3 * _BINS)) * n + suffix[k]
                if cost < best:
                    best, best_axis, best_cut = cost, axis, k
    return best_axis, best_cut


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
def _sorted(box, ids, start, stop, axis):
    """Sorts a few primitives by their centres along an axis, and equal ones by their ids."""
    for i in range(start + 1, stop):
        j = i
        while j > start:
            own, other = box[j, axis] + box[j, 3 + axis], box[j - 1, axis] + box[j - 1, 3 + axis]
            if not (own < other or (own == other and ids[j] < ids[j - 1])):
                break
            for c in range(6):
                box[j, c], box[j - 1, c] = box[j - 1, c], box[j, c]
            ids[j], ids[j - 1] = ids[j - 1], ids[j]
            j -= 1


@jit()
def _exact_split(box, ids, start, stop, bins, suffix):
    """Sorts a few primitives along the axis that splits them at the least cost; returns where the upper side starts."""
    best, best_axis, best_cut = np.float64(np.inf), 2, (start + stop) // 2
    for axis in range(3):
        _sorted(box, ids, start, stop, axis)
        _clear(bins, 0)
        for i in range(stop - 1, start, -1):
            _grow(bins, 0, box, i)
            suffix[i - start] = np.float64(half_area(bins, 0))
        _clear(bins, 0)
        for i in range(start + 1, stop):
            _grow(bins, 0, box, i - 1)
            cost = np.float64(half_area(bins, 0)) * (i - start) + suffix[i - start] * (stop - i)
            if cost < best:
                best, best_axis, best_cut = cost, axis, i
    _sorted(box, ids, start, stop, best_axis)
    return best_cut


@jit()
def build_binary(box, ids, nodes, spans, common):
    """Binary tree over primitives.

    Its leaves hold at most :data:`WIDTH` primitives, and one alone where these are far from each other: where their areas
    sum to less than that of the box about them, or where they are not of the common kind, which are tested together.

    Args:
        box: ``(L, 6)`` float32 boxes; permuted in place.
        ids: ``(L,)`` int32; permuted alike.
        nodes: ``(2 L, 6)`` float32, filled with boxes.
        spans: ``(2 L, 3)`` int32, filled: first primitive, one past the last, first child (0 for a leaf; the second
            child follows it).
        common: ids below are of the common kind.

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
        areas, rare = np.float64(0.0), False
        for i in range(start, stop):
            _grow(nodes, node, box, i)
            areas += np.float64(half_area(box, i))
            rare = rare or ids[i] >= common
            for c in range(3):
                centre = box[i, c] + box[i, 3 + c]
                low[c] = min(low[c], centre)
                high[c] = max(high[c], centre)
        few = stop - start <= WIDTH
        if stop - start > 1 and (not few or rare or areas < half_area(nodes, node)):
            if few:
                middle = _exact_split(box, ids, start, stop, bins, suffix)
            else:
                for c in range(3):
                    size = high[c] - low[c]
                    scale[c] = np.float32(_BINS) / size if size > _ZERO else _ZERO
                    if not scale[c] < _INF:
                        scale[c] = _ZERO
                axis, cut = _best_split(box, start, stop, low, scale, bins, counts, suffix)
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
