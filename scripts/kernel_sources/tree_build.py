"""Build an eight-wide BVH: a binary tree by the surface area heuristic, collapsed, then laid out in memory.

:mod:`torchpt.search.tree_build` calls these kernels in this order. A *box* is a row of six: low x, y, z, high x, y, z. The
layout in memory is explained in :mod:`torchpt.search.tree_layout`.
"""

from __future__ import annotations

import numpy as np
from numba.np.numpy_support import carray

from kernel_sources.jit import INT, array, inner, kernel
from kernel_sources.simd import (
    absolute,
    as_float,
    as_int,
    bits,
    item,
    lane_numbers,
    load_masked,
    maximum,
    minimum,
    narrow,
    select,
    splat,
    square_root,
    stack_memory,
    store,
    trailing_zeros,
    widen,
)
from torchpt.search.tree_layout import CHILDREN, IDS, LEAF, LINE, MORE, NODE, PLANES, RECTANGLES, RULED, WIDTH

__all__ = [
    "boxes_of",
    "build_binary",
    "choose_collapse",
    "collapse",
    "lay_out",
    "leaf_ids",
    "planes_of",
    "triangle_tables",
]


# ---- Binary trees by the surface area heuristic: binned (Wald, "On fast Construction of SAH-based Bounding Volume
# Hierarchies", 2007); the last few primitives by a full sweep


#: Bins of an axis, as in the paper.
_BINS = 16
#: Bins of three axes, and the numbers of their boxes and of one more box.
_COUNTS, _BIN_NUMBERS = 3 * _BINS, 6 * (3 * _BINS + 1)
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)


@inner(forceinline=True)
def _half_area(b, k):
    """Compute half the surface area of a box."""
    x, y, z = b[k, 3] - b[k, 0], b[k, 4] - b[k, 1], b[k, 5] - b[k, 2]
    return x * y + y * z + z * x


@inner(forceinline=True)
def _clear(b, k):
    """Set box ``k`` to the empty box."""
    for c in range(3):
        b[k, c] = _INF
        b[k, 3 + c] = -_INF


@inner(forceinline=True)
def _grow(b, k, x, i):
    """Extend box ``k`` of ``b`` by box ``i`` of ``x``."""
    for c in range(3):
        b[k, c] = min(b[k, c], x[i, c])
        b[k, 3 + c] = max(b[k, 3 + c], x[i, 3 + c])


@inner(forceinline=True)
def _bin(box, i, axis, low, scale):
    """Return the bin of a primitive by twice its centre, whose least value is ``low``; ``scale`` is bins for each unit."""
    k = int((box[i, axis] + box[i, 3 + axis] - low) * scale)
    return min(max(k, 0), _BINS - 1)


@inner()
def _best_split(box, start, stop, low, scale, bins, counts, suffix):
    """Find the split of least SAH cost (Wald 2007): axis (-1: none), first bin of the upper side.

    ``bins`` and ``counts`` are boxes and numbers of primitives of the bins of three axes; ``suffix[k]`` is the cost of the bins
    from ``k`` on.
    """
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
    return best_axis, best_cut


@inner()
def _partition(box, ids, start, stop, axis, cut, low, scale):
    """Move the primitives of the lower bins to the front; return the start of the upper side."""
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


@inner()
def _sorted(box, ids, start, stop, axis):
    """Sort a few primitives by their centres along an axis, equal ones by id."""
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


@inner()
def _exact_split(box, ids, start, stop, bins, suffix):
    """Sort a few primitives along the axis of the split of least SAH cost; return the start of the upper side."""
    best, best_axis, best_cut = np.float64(np.inf), 2, (start + stop) // 2
    for axis in range(3):
        _sorted(box, ids, start, stop, axis)
        _clear(bins, 0)
        for i in range(stop - 1, start, -1):
            _grow(bins, 0, box, i)
            suffix[i - start] = np.float64(_half_area(bins, 0))
        _clear(bins, 0)
        for i in range(start + 1, stop):
            _grow(bins, 0, box, i - 1)
            cost = np.float64(_half_area(bins, 0)) * (i - start) + suffix[i - start] * (stop - i)
            if cost < best:
                best, best_axis, best_cut = cost, axis, i
    _sorted(box, ids, start, stop, best_axis)
    return best_cut


@kernel("tree_build", array("f4", 2), array("i4"), array("f4", 2), array("i4", 2), INT)
def build_binary(box, ids, nodes, spans, common):
    """Build a binary tree over primitives.

    A leaf holds at most :data:`WIDTH` primitives. Primitives are split down to one a leaf if they are not of the common kind
    (only those are tested together), or if their areas sum to less than the area of their bounding box.

    Args:
        box: ``(L, 6)`` float32 boxes; permuted in place.
        ids: ``(L,)`` int32; permuted alike.
        nodes: ``(2 L, 6)`` float32, filled with boxes.
        spans: ``(2 L, 3)`` int32, filled: first primitive, one past the last, first child (0 for a leaf; the second
            child follows it).
        common: primitives with smaller ids are of the common kind.

    Returns:
        The number of nodes; node 0 is the root.
    """
    bins = carray(stack_memory(_BIN_NUMBERS, np.float32), (3 * _BINS + 1, 6))
    counts = carray(stack_memory(_COUNTS, np.int64), (_COUNTS,))
    suffix = carray(stack_memory(_BINS, np.float64), (_BINS,))
    low, high = carray(stack_memory(3, np.float32), (3,)), carray(stack_memory(3, np.float32), (3,))
    scale = carray(stack_memory(3, np.float32), (3,))
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
            areas += np.float64(_half_area(box, i))
            rare = rare or ids[i] >= common
            for c in range(3):
                centre = box[i, c] + box[i, 3 + c]
                low[c] = min(low[c], centre)
                high[c] = max(high[c], centre)
        few = stop - start <= WIDTH
        if stop - start > 1 and (not few or rare or areas < _half_area(nodes, node)):
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


# ---- Collapse of a binary tree to the wide tree of least SAH cost
#
# By dynamic programming over the binary tree, as in section 3.1 of Ylitie, Karras and Laine, "Efficient Incoherent Ray
# Traversal on GPUs Through Compressed Wide BVHs" (2017): each subtree becomes a leaf, a wide node, or up to seven of its
# parent's children, whichever costs least by the surface area heuristic.


_INF, _ZERO = np.float32(np.inf), np.float32(0.0)
#: Cost of testing a leaf's eight triangles, its rectangles, and each other primitive, in units of a visit of a wide node.
_TRIANGLES, _RECTANGLES, _OTHER = np.float32(1.0), np.float32(1.3), np.float32(2.0)


#: Room for the binary nodes that wait while the children of a wide node are listed.
_TWO_NODES = 2 * WIDTH


@inner()
def _leaf_cost(ids, start, stop, rectangle, other):
    """Return the cost of testing the primitives ``ids[start:stop]`` as a leaf; arguments as for :func:`choose_collapse`."""
    ruled, more = False, _ZERO
    for i in range(start, stop):
        ruled = ruled or rectangle <= ids[i] < other
        more += _OTHER if ids[i] >= other else _ZERO
    return _TRIANGLES + more + (_RECTANGLES if ruled else _ZERO)


@kernel("tree_build", array("f4", 2), array("i4", 2), array("i4"), INT, INT, array("f4", 2), array("i1", 2))
def choose_collapse(nodes, spans, ids, rectangle, other, cost, share):
    """Find the cheapest use of each node of a binary tree.

    Args:
        nodes: boxes ``(M, 6)`` float32.
        spans: ``(M, 3)`` int32: first primitive, one past the last, first child (0 for none).
        ids: ``(L,)`` primitives in the tree's order.
        rectangle: id of the first primitive that is no triangle.
        other: id of the first primitive that is neither triangle nor rectangle.
        cost: ``(M, WIDTH)`` float32, filled: cost of the subtree as at most 1, 2, ... children of a wide node.
        share: ``(M, WIDTH)`` int8, filled: how many of these children come from the node's first child; 0 if fewer children
            cost no more. In column 0: 0 for a leaf, else a wide node with so many of its eight children from the first child.
    """
    for node in range(len(nodes) - 1, -1, -1):  # children come after their parents
        start, stop, left = spans[node, 0], spans[node, 1], spans[node, 2]
        area = _half_area(nodes, node)
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


@inner()
def _children(root, spans, share, slots, nodes, room):
    """Fill ``slots`` with the binary nodes that are the children of a wide node; return their number.

    ``root`` is the binary node of the wide one. ``nodes`` and ``room`` are a stack: a binary node, and the number of children
    that its subtree may become.
    """
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


@kernel(
    "tree_build",
    *(array("f4", 2), array("i4", 2), array("i1", 2)),
    *(array("f4"), array("i4"), array("i4", 2)),
    *(array("i4", 2), array("i4")),
)
def collapse(nodes, spans, share, boxes, child, first, pending, found):
    """Build the wide tree that :func:`choose_collapse` found.

    Args:
        nodes: boxes of the binary tree.
        spans: topology of the binary tree.
        share: result of :func:`choose_collapse`.
        boxes: ``(M * 48,)`` float32, filled: per node low x, y, z, high x, y, z of 8 children; empty ones at infinity.
        child: ``(M * 8,)`` int32, filled: a node, or ``~leaf``.
        first: ``(K, 2)`` int32, filled: the primitives of each leaf.
        pending: ``(M + 1, 2)`` int32 scratch memory: binary node and depth of each wide node.
        found: ``(3,)`` int32, filled: numbers of nodes and leaves, and the depth.
    """
    pending[0, 0], pending[0, 1] = 0, 1
    slots = carray(stack_memory(WIDTH, np.int32), (WIDTH,))
    stack = carray(stack_memory(_TWO_NODES, np.int32), (_TWO_NODES,))
    room = carray(stack_memory(_TWO_NODES, np.int32), (_TWO_NODES,))
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
    found[0], found[1], found[2] = used, leaves, depth


# ---- Memory layout: blocks of cache lines


_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@inner()
def _kinds(ids, first, triangles, disk):
    """Return 2 if a leaf holds rectangles, plus 1 if it holds primitives that are neither triangles nor rectangles."""
    found = 0
    for k in range(8):
        q = ids[first + k]
        if q >= disk:
            found |= 1
        elif q >= triangles:
            found |= 2
    return found


@inner()
def _leaf(base, tree, codes, ids, first, p0, p1, p2, planes, triangles):
    """Write the triangles and ids of a leaf."""
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


@inner()
def _rectangles(base, tree, ids, first, corner, rows, triangles, disk):
    """Write the rectangles of a leaf."""
    for k in range(8):
        q = ids[first + k]
        here = triangles <= q < disk
        for c in range(12):
            tree[base + RECTANGLES + c * 8 + k] = corner[q - triangles, c] if here else _NAN
        for c in range(4):
            tree[base + RECTANGLES + RULED + c * 8 + k] = rows[q - triangles, c] if here else _NAN


@kernel(
    "tree_build",
    array("f4"),
    *(array("i4"),) * 2,
    *(array("f4", 2),) * 6,
    INT,
    INT,
    INT,
    array("f4"),
    array("i4"),
    array("i8"),
    array("i4"),
)
def lay_out(boxes, child, ids, p0, p1, p2, planes, corner, rows, triangles, disk, line, tree, codes, lines, stack):
    """Fill the blocks of a tree: parents before children, each node followed by its leaves.

    Args:
        boxes: ``(M * 48,)`` float32: low x, y, z, high x, y, z of eight children a node; infinite for none.
        child: ``(M * 8,)`` int32: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)`` int32 primitives of the leaves in rising order, -1 for none.
        p0: ``(3, P)`` corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        planes: ``(T, 4)`` planes of the triangles.
        corner: ``(K, 12)`` corners of the other primitives.
        rows: ``(K, 12)`` affine rows of the other primitives.
        triangles: number of triangles among the P primitives; they come first.
        disk: id of the first primitive that is neither triangle nor rectangle.
        line: line of ``tree`` at which the root begins.
        tree: float32, filled: ``4 M + 7 L`` lines, and 8 for each leaf that holds rectangles.
        codes: the same memory as int32.
        lines: ``(M,)`` int64 scratch memory.
        stack: ``(M * 8 + 8,)`` int32 scratch memory.
    """
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
                # an empty box, which no ray hits
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


# ---- Planes and boxes of triangles: the float64 operations of ``tables.affine_rows`` and ``bounds`` in one pass
#
# Eight triangles are processed together, as vectors of float64.


#: As in :mod:`torchpt.search.bounds`.
_MARGIN = 2.0**-22


@inner(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner(forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner(forceinline=True)
def _finite(row, p):
    """Return the mask of the affine rows ``row . (x - p)`` whose numbers are finite in float32."""
    total, zero = narrow(row[0]) + narrow(row[1]) + narrow(row[2]) + narrow(-_dot(row, p)), splat(_ZERO, 8)
    return total * zero == zero


@inner(forceinline=True)
def planes_of(a, b, c):
    """Compute the planes (unit normal, distance) of eight triangles from float64 corners, and the mask of those with an area.

    See :func:`torchpt.search.tables.affine_rows`. The planes of triangles outside of the mask are undefined.
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


@inner(forceinline=True)
def _down(x):
    """Round float64 lanes down to float32."""
    near, one = narrow(x), splat(np.int32(1), 8)
    whole, zero = as_int(near), splat(np.int32(0), 8)
    # The next float32 below: its bits less 1, plus 1 for a negative number.
    below = select(whole < zero, whole + one, whole - one)
    below = select(near == splat(_ZERO, 8), splat(np.int32(-(2**31) + 1), 8), below)
    return select(widen(near) > x, as_float(below), near)


@inner(forceinline=True)
def _span(a, b, c):
    """Return the least and the greatest of three values, lane by lane."""
    return minimum(minimum(a, b), c), maximum(maximum(a, b), c)


@inner(forceinline=True)
def boxes_of(a, b, c):
    """Compute the boxes of eight triangles with a margin: low x, y, z, high x, y, z.

    See :func:`torchpt.search.bounds.primitive_bounds`.
    """
    x0, x1 = _span(a[0], b[0], c[0])
    y0, y1 = _span(a[1], b[1], c[1])
    z0, z1 = _span(a[2], b[2], c[2])
    size, share = maximum(maximum(x1 - x0, y1 - y0), z1 - z0), splat(_MARGIN, 8)
    x = share * (maximum(absolute(x0), absolute(x1)) + size)
    y = share * (maximum(absolute(y0), absolute(y1)) + size)
    z = share * (maximum(absolute(z0), absolute(z1)) + size)
    return _down(x0 - x), _down(y0 - y), _down(z0 - z), -_down(-(x1 + x)), -_down(-(y1 + y)), -_down(-(z1 + z))


@inner(forceinline=True)
def _corner(p, i, some):
    """Load a corner of the eight triangles from ``i`` on where the mask is set, as float64."""
    n, none = p.shape[1], splat(_ZERO, 8)
    x, y, z = (
        load_masked(p, i, some, none),
        load_masked(p, n + i, some, none),
        load_masked(p, 2 * n + i, some, none),
    )
    return widen(x), widen(y), widen(z)


@kernel("tree_build", *(array("f4", 2),) * 3, INT, *(array("f4", 2),) * 2, array("i4"))
def triangle_tables(p0, p1, p2, count, planes, boxes, ids):
    """Compute the planes of the first ``count`` primitives, and the boxes of those that can be hit.

    Args:
        p0: ``(3, P)`` float32 corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        count: number of triangles among the primitives.
        planes: ``(count, 4)`` float32, filled: unit normal and distance; zeros where a triangle has no area.
        boxes: ``(count, 6)`` float32, filled from the front.
        ids: ``(count,)`` int32, filled alike.

    Returns:
        The number of triangles that can be hit.
    """
    kept = 0
    row, box, none = stack_memory(32, np.float32), stack_memory(48, np.float32), splat(_ZERO, 8)
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
                planes[i + k, j] = item(row, j * 8 + k)
        left = bits(good)
        while left != 0:
            k = trailing_zeros(left)
            left &= left - 1
            for j in range(6):
                boxes[kept, j] = item(box, j * 8 + k)
            ids[kept] = i + k
            kept += 1
    return kept


@kernel("tree_build", array("i4", 2), array("i4"), array("i4", 2))
def leaf_ids(first, ids, slots):
    """Fill ``slots (L, 8)`` with the sorted primitives of leaves, which span ``first (L, 2)`` of ``ids``; -1 behind them."""
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
