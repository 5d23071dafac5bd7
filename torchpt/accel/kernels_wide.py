"""Traversal of the wide tree (numba): one ray at a time, eight child boxes or eight triangles at once."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.kernels_build import WIDTH
from torchpt.accel.kernels_leaf import distance, setup
from torchpt.native.jit import jit
from torchpt.native.vector import at, larger, smaller

__all__ = [
    "LOWEST",
    "SLACK",
    "children",
    "finite",
    "inside",
    "intersect",
    "intersect_parallel",
    "occluded",
    "occluded_parallel",
    "push",
]  # fmt: skip

SLACK = np.float32(1.0 + 2.0**-20)  # as in torchpt.accel.traverse
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
#: Place of the lowest set bit of a byte.
LOWEST = np.array([0, *((k & -k).bit_length() - 1 for k in range(1, 1 << WIDTH))], np.int32)


@jit(forceinline=True)
def children(boxes, node, o, inverse, best, near, unit):
    """Entry distances of a node's eight boxes; returns one bit for each that is met before ``best``."""
    base = node * 6 * WIDTH
    met = np.int32(0)
    for k in range(unit * WIDTH):
        i = base + k
        ax, bx = (boxes[at(i)] - o[0]) * inverse[0], (boxes[at(i + 3 * WIDTH)] - o[0]) * inverse[0]
        ay, by = (boxes[at(i + WIDTH)] - o[1]) * inverse[1], (boxes[at(i + 4 * WIDTH)] - o[1]) * inverse[1]
        az, bz = (boxes[at(i + 2 * WIDTH)] - o[2]) * inverse[2], (boxes[at(i + 5 * WIDTH)] - o[2]) * inverse[2]
        a = larger(larger(smaller(ax, bx), smaller(ay, by)), larger(smaller(az, bz), _ZERO))
        b = smaller(smaller(larger(ax, bx), larger(ay, by)), smaller(larger(az, bz), best)) * SLACK
        near[k] = a
        met |= (np.int32(1) << np.int32(k)) if (a <= b) & (a < _INF) else np.int32(0)
    return met


@jit(forceinline=True)
def push(child, node, met, near, stack, entry, top):
    """Puts the boxes that were met on the stack, the nearest on top."""
    bottom = top
    while met != 0:
        k = LOWEST[met]
        met &= met - np.int32(1)
        a = near[k]
        j = top
        while j > bottom and entry[j - 1] < a:
            entry[j], stack[j] = entry[j - 1], stack[j - 1]
            j -= 1
        entry[j], stack[j] = a, child[node * WIDTH + k]
        top += 1
    return top


@jit(forceinline=True)
def inside(corners, leaf, px, py, pz, kx, ky, kz, sx, sy, unit):
    """One bit for each of a leaf's eight triangles that the ray's line crosses."""
    base = leaf * 9 * WIDTH
    crossed = np.int32(0)
    x, y, z = base + kx * WIDTH, base + ky * WIDTH, base + kz * WIDTH
    for k in range(unit * WIDTH):
        i, j = 3 * WIDTH + k, 6 * WIDTH + k
        za, zb, zc = corners[at(z + k)] - pz, corners[at(z + i)] - pz, corners[at(z + j)] - pz
        ax, ay = (corners[at(x + k)] - px) - sx * za, (corners[at(y + k)] - py) - sy * za
        bx, by = (corners[at(x + i)] - px) - sx * zb, (corners[at(y + i)] - py) - sy * zb
        cx, cy = (corners[at(x + j)] - px) - sx * zc, (corners[at(y + j)] - py) - sy * zc
        e = cx * by - cy * bx
        f = ax * cy - ay * cx
        g = bx * ay - by * ax
        low, high = smaller(smaller(e, f), g), larger(larger(e, f), g)
        # a missing triangle is NaN in all corners, and NaN is neither
        crossed |= (np.int32(1) << np.int32(k)) if (low >= _ZERO) | (high <= _ZERO) else np.int32(0)
    return crossed


@jit(forceinline=True)
def finite(a, b, c):
    """Whether three numbers are all finite."""
    return a * _ZERO + b * _ZERO + c * _ZERO == _ZERO


@jit()
def _trace(first, last, o, d, t_max, tree, kinds, room, unit, any_hit, out_t, out_prim, out_u, out_v):
    """The nearest hits of a range of rays, or for each any hit's primitive alone."""
    boxes, child, leaves, ids, full, corner, rows, quadrics = tree
    n1, n2, n3, n4 = kinds
    stack, entry = np.empty(room, np.int32), np.empty(room, np.float32)
    near = np.empty(WIDTH, np.float32)
    for i in range(first, last):
        p, r, best = (o[0, i], o[1, i], o[2, i]), (d[0, i], d[1, i], d[2, i]), t_max[i]
        prim, best_u, best_v = np.int32(-1), _ZERO, _ZERO
        top = 0
        if best > _ZERO and finite(p[0], p[1], p[2]) and finite(r[0], r[1], r[2]):
            stack[0], entry[0] = 0, _ZERO
            top = 1
        kx, ky, kz, sx, sy, sz, ix, iy, iz = setup(r[0], r[1], r[2])
        px, py, pz = o[kx, i], o[ky, i], o[kz, i]
        while top > 0:
            top -= 1
            node = stack[top]
            if entry[top] > best * SLACK:
                continue
            if node >= 0:
                met = children(boxes, node, p, (ix, iy, iz), best, near, unit)
                top = push(child, node, met, near, stack, entry, top)
                continue
            leaf = ~node
            left = full[leaf]
            if left < 0:
                left = inside(leaves, leaf, px, py, pz, kx, ky, kz, sx, sy, unit)
            while left != 0:
                q = ids[leaf * WIDTH + LOWEST[left]]
                left &= left - np.int32(1)
                t, u, v = distance(q, corner, rows, quadrics, n1, n2, n3, n4, p, r, kx, ky, kz, sx, sy, sz)
                if t > _ZERO and (t < best or (t == best and q < prim)):
                    best, prim, best_u, best_v = t, q, u, v
                    if any_hit:
                        top = 0
                        break
        out_prim[i] = prim
        if not any_hit:
            out_t[i] = best if prim >= 0 else _INF
            out_u[i], out_v[i] = best_u, best_v


@jit()
def intersect(first, last, o, d, t_max, tree, kinds, room, unit, t, prim, u, v):
    """Nearest hits of the rays ``first <= i < last``; ``room`` is the size of the stack, ``unit`` is 1.

    The loops over eight run to ``8 * unit``: LLVM would unroll a loop of eight before it looks for vectors.
    """
    _trace(first, last, o, d, t_max, tree, kinds, room, unit, False, t, prim, u, v)


@jit(parallel=True)
def intersect_parallel(chunks, items, o, d, t_max, tree, kinds, room, unit, t, prim, u, v):
    """:func:`intersect` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        intersect(a, b, o, d, t_max, tree, kinds, room, unit, t, prim, u, v)


@jit()
def occluded(first, last, o, d, t_max, tree, kinds, room, unit, prim):
    """Some primitive that each of the rays ``first <= i < last`` hits, or -1."""
    _trace(first, last, o, d, t_max, tree, kinds, room, unit, True, t_max, prim, t_max, t_max)


@jit(parallel=True)
def occluded_parallel(chunks, items, o, d, t_max, tree, kinds, room, unit, prim):
    """:func:`occluded` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        occluded(a, b, o, d, t_max, tree, kinds, room, unit, prim)
