"""The wide SAH tree: built as a binary one, collapsed to eight children a node, laid out in memory (numba)."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.native.jit import jit, jit_internal
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
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.bounds import primitive_bounds
from torchpt.search.tables import QUADRIC, affine_rows, quadric_rows
from torchpt.search.tree_layout import CHILDREN, IDS, LEAF, LINE, MORE, NODE, PLANES
from torchpt.search.tree_leaf import RECTANGLES, RULED

__all__ = [
    "WIDTH",
    "NonTriangles",
    "WideTree",
    "aligned_buffer",
    "boxes_of",
    "build_binary",
    "choose_collapse",
    "collapse",
    "corners",
    "half_area",
    "lay_out",
    "leaf_ids",
    "line_count",
    "mesh_tree",
    "planes_of",
    "primitive_tables",
    "stack_size",
    "triangle_tables",
    "wide_tree",
    "write_tree",
]


# ---- Binary trees by the surface area heuristic (numba): binned (Wald 2007), and exact over the last few primitives


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


# ---- From a binary tree to the wide one that rays are expected to search at the least cost (numba)
#
# By dynamic programming over the binary tree, as in section 3.1 of Ylitie, Karras and Laine, "Efficient Incoherent Ray
# Traversal on GPUs Through Compressed Wide BVHs" (2017): what is below a node becomes a leaf, a wide node, or up to seven of
# its parent's children, whichever costs least by the surface area heuristic.


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
def choose_collapse(nodes, spans, ids, rectangle, other, cost, share):
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
    """Writes down the wide tree that :func:`choose_collapse` found.

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


# ---- From a tree of boxes to blocks of cache lines (numba)


_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@jit_internal()
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


@jit_internal()
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


@jit_internal()
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


# ---- What the tree needs of triangles (numba): the float64 operations of ``tables.affine_rows`` and ``bounds`` in one pass
#
# Eight triangles go together, as vectors of float64.


_MARGIN = 2.0**-22


@jit_internal(forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@jit_internal(forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit_internal(forceinline=True)
def _finite(row, p):
    """Whether affine rows about points are finite in float32."""
    total, zero = narrow(row[0]) + narrow(row[1]) + narrow(row[2]) + narrow(-_dot(row, p)), splat(_ZERO, 8)
    return total * zero == zero


@jit_internal(forceinline=True)
def planes_of(a, b, c):
    """Unit normals and distances of eight triangles by float64 corners, and which can be hit.

    See :func:`torchpt.search.tables.affine_rows`. The numbers of those that cannot mean nothing.
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


@jit_internal(forceinline=True)
def _down(x):
    """The float32 below float64 lanes, or their own."""
    near, one = narrow(x), splat(np.int32(1), 8)
    whole, zero = as_int(near), splat(np.int32(0), 8)
    # the next float32: one less in its bits, one more where they are those of a negative number
    below = select(whole < zero, whole + one, whole - one)
    below = select(near == splat(_ZERO, 8), splat(np.int32(-(2**31) + 1), 8), below)
    return select(widen(near) > x, as_float(below), near)


@jit_internal(forceinline=True)
def _span(a, b, c):
    return minimum(minimum(a, b), c), maximum(maximum(a, b), c)


@jit_internal(forceinline=True)
def boxes_of(a, b, c):
    """Boxes of eight triangles with their margin: low x, y, z, high x, y, z.

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


@jit_internal(forceinline=True)
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


# ---- Trees for the CPU's search: binary over boxes, then of eight children a node, then blocks of cache lines


Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class WideTree:
    """A tree of boxes, before it is laid out.

    Attributes:
        boxes: ``(M * 48,)``: low x, y, z, high x, y, z of eight children a node; infinite where there is none.
        child: ``(M * 8,)``: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)``: what the leaves hold, in rising order, -1 where there is nothing.
        depth: nodes on the longest way down.
        cost: expected work of a ray, 1 a node; see :mod:`torchpt.search.tree_build`.
    """

    def __init__(self, boxes: Floats, child: Ints, ids: Ints, depth: int, cost: float) -> None:
        self.boxes, self.child, self.ids, self.depth, self.cost = boxes, child, ids, depth, cost

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return len(self.child) // WIDTH

    @property
    def leaves(self) -> int:
        """How many leaves there are."""
        return len(self.ids) // WIDTH


class NonTriangles:
    """The K primitives of a geometry that are no triangles.

    Attributes:
        area: ``(K,)`` bool: the primitive can be hit.
        boxes: ``(K, 6)`` float32: low x, y, z, high x, y, z; a box that ends before it begins where it cannot be hit.
        tensors: what the search's kernels take of them: corners ``(K, 12)`` float32, affine rows ``(K, 12)`` float32 and
            quadrics ``(Q, 19)`` float64; NaN, which no ray meets, where a primitive cannot be hit.
    """

    def __init__(self, geometry: Geometry) -> None:
        rest = _without_triangles(geometry)
        if not rest.size:  # the operations below would take longer than the tree of a small mesh
            self.area, self.boxes = np.zeros(0, bool), np.zeros((0, 6), np.float32)
            self.tensors = [torch.zeros(0, 12), torch.zeros(0, 12), torch.zeros(0, QUADRIC, dtype=torch.float64)]
            return
        tables = affine_rows(rest)
        good = tables.area
        low, high = primitive_bounds(rest)
        boxes = torch.cat((torch.where(good, low, torch.inf), torch.where(good, high, -torch.inf)))
        self.area, self.boxes = good.numpy(), boxes.T.contiguous().numpy()
        corner = torch.cat([rest.p0, rest.p1, rest.p2, (rest.p1 + rest.p2) - rest.p0]).float()
        corner, quadrics = torch.where(good, corner, torch.nan), quadric_rows(rest)
        quadrics = torch.where(good[rest.size - rest.counts[4] :], quadrics, torch.nan)
        self.tensors = [corner.T.contiguous(), tables.rows, quadrics.T.contiguous()]


def wide_tree(boxes: Floats, ids: Ints, counts: tuple[int, ...] = (0, 0)) -> WideTree:
    """Builds over boxes ``(L, 6)`` of ``ids (L,)``; both are permuted.

    ``counts`` says how many triangles there are and how many rectangles, whose ids come first in this order.
    """
    n = len(ids)
    if n == 0:
        return WideTree(
            np.full(6 * WIDTH, np.inf, np.float32), np.zeros(WIDTH, np.int32), np.zeros(0, np.int32), 1, 0.0
        )
    nodes, spans = np.empty((2 * n, 6), np.float32), np.empty((2 * n, 3), np.int32)
    used = build_binary(boxes, ids, nodes, spans, counts[0])
    nodes, spans = nodes[:used], spans[:used]
    cost, share = np.empty((used, WIDTH), np.float32), np.empty((used, WIDTH), np.int8)
    choose_collapse(nodes, spans, ids, counts[0], counts[0] + counts[1], cost, share)
    wide, ends = max(1, int((share[:, 0] > 0).sum())), int((share[:, 0] == 0).sum())
    flat, child = np.empty(wide * 6 * WIDTH, np.float32), np.empty(wide * WIDTH, np.int32)
    first = np.empty((ends, 2), np.int32)
    count, leaves, depth = collapse(nodes, spans, share, flat, child, first)
    slots = np.empty((leaves, WIDTH), np.int32)
    leaf_ids(first[:leaves], ids, slots)
    x, y, z = (nodes[0, 3:] - nodes[0, :3]).astype(np.float64)
    area = x * y + y * z + z * x
    # Expected cost of a random ray through the root's box (MacDonald & Booth 1990).
    expected = float(cost[0, 0] / area) if area > 0 else float(n)
    return WideTree(flat[: count * 6 * WIDTH], child[: count * WIDTH], slots.reshape(-1), depth, expected)


def line_count(tree: WideTree, counts: tuple[int, ...]) -> int:
    """Cache lines that a tree takes over primitives of which there are ``counts`` of each kind."""
    ids = tree.ids.reshape(-1, WIDTH)
    ruled = ((ids >= counts[0]) & (ids < counts[0] + counts[1])).any(1).sum() if counts[1] else 0
    return NODE * tree.nodes + LEAF * tree.leaves + MORE * int(ruled)


def stack_size(depth: int) -> int:
    """Entries of a stack for trees of that depth: seven a level stay, and eight are written at once."""
    return depth * (WIDTH - 1) + 2 * WIDTH


def aligned_buffer(count: int) -> Floats:
    """Memory for ``count`` float32 that begins with a cache line."""
    raw = np.zeros(count * 4 + LINE * 4, np.uint8)
    skip = -raw.ctypes.data % (LINE * 4)
    return raw[skip : skip + count * 4].view(np.float32)


def primitive_tables(geometry: Geometry) -> tuple[Floats, Floats, Ints, NonTriangles]:
    """Planes ``(T, 4)`` of the triangles, boxes ``(K, 6)`` and rising ids ``(K,)`` of those with an area, and the others."""
    count = geometry.counts[0]
    planes, boxes, ids = np.empty((count, 4), np.float32), np.empty((count, 6), np.float32), np.empty(count, np.int32)
    kept = triangle_tables(*corners(geometry), count, planes, boxes, ids)
    return planes, boxes[:kept], ids[:kept], NonTriangles(geometry)


def mesh_tree(geometry: Geometry) -> tuple[WideTree, Floats, NonTriangles]:
    """The tree over a geometry's primitives, the planes ``(T, 4)`` of its triangles, and what there is of others."""
    planes, boxes, ids, non_triangles = primitive_tables(geometry)
    if non_triangles.area.size:
        keep = np.flatnonzero(non_triangles.area)
        boxes = np.concatenate([boxes, non_triangles.boxes[keep]])
        ids = np.concatenate([ids, (keep + geometry.counts[0]).astype(np.int32)])
    return wide_tree(boxes, ids, geometry.counts), planes, non_triangles


def write_tree(
    tree: WideTree, geometry: Geometry, planes: Floats, non_triangles: NonTriangles, line: int, memory: Floats
) -> None:
    """Lays a tree out in ``memory`` from a line on."""
    codes, triangles = memory.view(np.int32), geometry.counts[0]
    disk = triangles + geometry.counts[1]
    tables = (planes, non_triangles.tensors[0].numpy(), non_triangles.tensors[1].numpy())
    lay_out(tree.boxes, tree.child, tree.ids, *corners(geometry), *tables, triangles, disk, line, memory, codes)


def corners(geometry: Geometry) -> tuple[Floats, Floats, Floats]:
    """The three corners ``(3, P)`` as arrays."""
    return tuple(p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))  # type: ignore[return-value]


def _without_triangles(geometry: Geometry) -> Geometry:
    _, *counts = geometry.counts
    p0, p1, p2 = (p[:, geometry.counts[0] :] for p in (geometry.p0, geometry.p1, geometry.p2))
    return Geometry(p0, p1, p2, (0, counts[0], counts[1], counts[2], counts[3]), geometry.quadrics)
