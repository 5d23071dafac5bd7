"""Build the light tree in float64: top down, nodes of eight children, splitting the child of highest cost.

Conty Estevez and Kulla, "Importance Sampling of Many Lights with Adaptive Tree Splitting", Proc. ACM Comput. Graph. Interact.
Tech. 1(2), 2018: the cost of a group of lights is intensity times spread of positions times spread of directions.
"""

from __future__ import annotations

import math

import numpy as np
from numba.np.numpy_support import carray

from kernel_sources.jit import array, inner, kernel
from kernel_sources.simd import stack_memory
from torchpt.physics.lights.tree import WIDTH

__all__ = ["build"]

#: Paths take three bits a level of an int64, which holds 21 levels. From this level on children get equal numbers of lights, so
#: that ten more levels suffice for any input: eight to the tenth is more lights than memory holds.
_EVEN = 11
#: Bins of a split along each axis; two more rows are the sums from the upper and from the lower end.
_BINS = 12
_UPPER, _LOWER = _BINS, _BINS + 1
#: Numbers of the bins, of the groups of a node's children, and of the ends of these groups.
_BIN_NUMBERS, _GROUP_NUMBERS, _CUTS = 12 * (_BINS + 2), 12 * WIDTH, WIDTH + 1
_INF = np.inf
_PI = math.pi

# A group of lights is a row of twelve: corners of the bounding box (low 3, high 3), sum of the axes weighted by intensity (3),
# cosine of the angle theta_e of the paper, intensity, count.


@inner()
def _clear(groups, k):
    """Set group ``k`` to one without lights."""
    for c in range(3):
        groups[k, c], groups[k, 3 + c], groups[k, 6 + c] = _INF, -_INF, 0.0
    groups[k, 9], groups[k, 10], groups[k, 11] = 1.0, 0.0, 0.0


@inner()
def _add(groups, k, others, i):
    """Add the lights of group ``i`` of ``others`` to group ``k``."""
    for c in range(3):
        groups[k, c] = min(groups[k, c], others[i, c])
        groups[k, 3 + c] = max(groups[k, 3 + c], others[i, 3 + c])
        groups[k, 6 + c] += others[i, 6 + c]
    groups[k, 9] = min(groups[k, 9], others[i, 9])
    groups[k, 10] += others[i, 10]
    groups[k, 11] += others[i, 11]


@inner()
def _length(x, y, z):
    return math.sqrt(x * x + y * y + z * z)


@inner()
def _angle(cosine):
    return math.acos(min(max(cosine, -1.0), 1.0))


@inner()
def _cost(groups, k):
    """Return the cost of a group: intensity times measure of directions times squared diagonal.

    The measure of directions is equation 1 of the paper. The half angle theta follows from the mean of the weighted axes,
    which has length ``(1 + cos theta) / 2`` for axes uniform over a cone.
    """
    if groups[k, 11] == 0.0:
        return 0.0
    mean = _length(groups[k, 6], groups[k, 7], groups[k, 8]) / groups[k, 10]
    theta_o = _angle(2.0 * mean - 1.0)
    theta_w = min(theta_o + _angle(groups[k, 9]), _PI)
    sin_o, cos_o = math.sin(theta_o), math.cos(theta_o)
    ring = 2.0 * theta_w * sin_o - math.cos(theta_o - 2.0 * theta_w) - 2.0 * theta_o * sin_o + cos_o
    directions = 2.0 * _PI * (1.0 - cos_o) + 0.5 * _PI * ring
    diagonal = _length(groups[k, 3] - groups[k, 0], groups[k, 4] - groups[k, 1], groups[k, 5] - groups[k, 2])
    return groups[k, 10] * directions * diagonal * diagonal


@inner()
def _gather(groups, k, lights, ids, start, stop):
    """Set group ``k`` to the lights ``ids[start:stop]``."""
    _clear(groups, k)
    for i in range(start, stop):
        _add(groups, k, lights, ids[i])


@inner()
def _bin(lights, i, axis, low, scale):
    """Return the bin of a light by twice its centre, whose least value is ``low``; ``scale`` is bins for each unit."""
    return min(max(int((lights[i, axis] + lights[i, 3 + axis] - low) * scale), 0), _BINS - 1)


@inner()
def _split(lights, ids, start, stop, bins, suffix):
    """Partition a range of lights into two groups of least cost; return the start of the second."""
    best, best_axis, best_cut, best_low, best_scale = _INF, -1, 0, 0.0, 0.0
    for axis in range(3):
        low, high = _INF, -_INF
        for i in range(start, stop):
            centre = lights[ids[i], axis] + lights[ids[i], 3 + axis]
            low, high = min(low, centre), max(high, centre)
        scale = _BINS / (high - low) if high > low else _INF
        if not scale < _INF:
            continue
        for k in range(_BINS + 2):
            _clear(bins, k)
        for i in range(start, stop):
            _add(bins, _bin(lights, ids[i], axis, low, scale), lights, ids[i])
        for k in range(_BINS - 1, 0, -1):
            _add(bins, _UPPER, bins, k)
            suffix[k] = _cost(bins, _UPPER)
        for k in range(1, _BINS):
            _add(bins, _LOWER, bins, k - 1)
            if 0.0 < bins[_LOWER, 11] < stop - start:
                cost = _cost(bins, _LOWER) + suffix[k]
                if cost < best:
                    best, best_axis, best_cut, best_low, best_scale = cost, axis, k, low, scale
    if best_axis < 0:  # all centres coincide
        return (start + stop) // 2
    i, j = start, stop - 1
    while i <= j:
        if _bin(lights, ids[i], best_axis, best_low, best_scale) < best_cut:
            i += 1
        else:
            ids[i], ids[j] = ids[j], ids[i]
            j -= 1
    return i


@inner()
def _cone(lights, cos_o, ids, start, stop):
    """Return axis and half angle of a cone that contains the cones of a range of lights."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(start, stop):
        k = ids[i]
        own = _length(lights[k, 6], lights[k, 7], lights[k, 8])
        if not own > 0.0:
            return 0.0, 0.0, 0.0, _PI
        x, y, z = x + lights[k, 6] / own, y + lights[k, 7] / own, z + lights[k, 8] / own
    whole = _length(x, y, z)
    if not whole > 0.0:
        return 0.0, 0.0, 0.0, _PI
    x, y, z = x / whole, y / whole, z / whole
    theta = 0.0
    for i in range(start, stop):
        k = ids[i]
        own = _length(lights[k, 6], lights[k, 7], lights[k, 8])
        off = _angle((x * lights[k, 6] + y * lights[k, 7] + z * lights[k, 8]) / own)
        theta = max(theta, off + _angle(cos_o[k]))
    return x, y, z, min(theta, _PI)


@kernel(
    "light_tree",
    array("f8", 2),
    array("f8"),
    array("i4"),
    array("f4", 3),
    array("i4", 2),
    *(array("i4"), array("i8"), array("i4")),
    *(array("i8", 2), array("i8"), array("i8")),
)
def build(lights, cos_o, ids, nodes, child, full, trail, depth, spans, level, way):
    """Build the tree.

    Args:
        lights: ``(K, 12)`` float64 groups of one light; axes have the length intensity times ``(1 + cos_o) / 2``.
        cos_o: ``(K,)`` cosine of the cone of axes.
        ids: ``(L,)`` lights of positive intensity; reordered.
        nodes: ``(max(L - 1, 1), F, 8)`` float32 zeros, filled: :data:`torchpt.physics.lights.tree.FIELDS`.
        child: ``(nodes, 8)`` int32, filled: a node, or ``~light``.
        full: ``(nodes,)`` int32, filled: number of children.
        trail: ``(K,)`` int64, filled: path from the root, three bits a level, the first lowest.
        depth: ``(K,)`` int32 zeros, filled: number of levels.
        spans: ``(nodes, 2)`` int64 zeros, scratch memory.
        level: ``(nodes,)`` likewise.
        way: ``(nodes,)`` likewise.

    Returns:
        The number of nodes; node 0 is the root.
    """
    bins = carray(stack_memory(_BIN_NUMBERS, np.float64), (_BINS + 2, 12))
    suffix = carray(stack_memory(_BINS, np.float64), (_BINS,))
    groups = carray(stack_memory(_GROUP_NUMBERS, np.float64), (WIDTH, 12))
    cuts = carray(stack_memory(_CUTS, np.int64), (_CUTS,))
    costs = carray(stack_memory(WIDTH, np.float64), (WIDTH,))
    groups[:, :] = 0.0
    cuts[:] = 0
    costs[:] = 0.0
    spans[0, 1] = len(ids)
    used, at = 1, 0
    while at < used:  # breadth first: the queue is the tree itself
        start, stop = spans[at, 0], spans[at, 1]
        count = 1
        cuts[0], cuts[1] = start, stop
        if stop - start <= WIDTH or level[at] >= _EVEN:
            count = min(WIDTH, stop - start)
            for k in range(count + 1):
                cuts[k] = start + (stop - start) * k // count
        while count < min(WIDTH, stop - start):
            dearest = -1
            for k in range(count):
                if cuts[k + 1] - cuts[k] > 1 and (dearest < 0 or costs[k] > costs[dearest]):
                    dearest = k
            middle = _split(lights, ids, cuts[dearest], cuts[dearest + 1], bins, suffix)
            for k in range(count, dearest, -1):
                cuts[k + 1], costs[k] = cuts[k], costs[k - 1]
            cuts[dearest + 1] = middle
            count += 1
            for k in range(dearest, dearest + 2):
                _gather(groups, 0, lights, ids, cuts[k], cuts[k + 1])
                costs[k] = _cost(groups, 0)
        brightest = 0.0
        for k in range(count):
            _gather(groups, k, lights, ids, cuts[k], cuts[k + 1])
            brightest = max(brightest, groups[k, 10])
        full[at] = count
        for k in range(count):
            square, reach = 0.0, 0.0
            for c in range(3):
                nodes[at, c, k] = 0.5 * (groups[k, c] + groups[k, 3 + c])
                half = 0.5 * (groups[k, 3 + c] - groups[k, c])
                square += half * half
                reach = max(reach, abs(groups[k, c]), abs(groups[k, 3 + c]))
            # Enlarged by the rounding of float32.
            nodes[at, 3, k] = math.sqrt(square) * (1.0 + 2.0**-20) + reach * 2.0**-21
            x, y, z, theta = _cone(lights, cos_o, ids, cuts[k], cuts[k + 1])
            nodes[at, 4, k], nodes[at, 5, k], nodes[at, 6, k] = x, y, z
            nodes[at, 7, k], nodes[at, 8, k] = math.cos(theta), math.sin(theta)
            nodes[at, 9, k] = groups[k, 9]
            nodes[at, 10, k] = groups[k, 10] / brightest
            bits = way[at] | (np.int64(k) << np.int64(3 * level[at]))
            if cuts[k + 1] - cuts[k] == 1:
                light = ids[cuts[k]]
                child[at, k] = ~light
                trail[light], depth[light] = bits, level[at] + 1
            else:
                child[at, k] = used
                spans[used, 0], spans[used, 1] = cuts[k], cuts[k + 1]
                level[used], way[used] = level[at] + 1, bits
                used += 1
        at += 1
    return used
