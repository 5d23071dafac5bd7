"""Traversal of the wide tree (numba): one ray at a time, eight child boxes or eight triangles at once."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.jit import jit
from torchpt.accel.kernels_build import WIDTH
from torchpt.accel.kernels_leaf import distance, setup

__all__ = ["intersect", "intersect_parallel", "occluded", "occluded_parallel"]

_SLACK = np.float32(1.0 + 2.0**-20)  # as in torchpt.accel.traverse
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@jit(forceinline=True)
def _children(boxes, node, o, inverse, best, near):
    """Entry distances of a node's eight boxes, infinite for those not met before ``best``."""
    base = node * 6 * WIDTH
    x0 = base + (3 * WIDTH if inverse[0] < _ZERO else 0)
    y0 = base + (4 * WIDTH if inverse[1] < _ZERO else WIDTH)
    z0 = base + (5 * WIDTH if inverse[2] < _ZERO else 2 * WIDTH)
    x1 = base + (0 if inverse[0] < _ZERO else 3 * WIDTH)
    y1 = base + (WIDTH if inverse[1] < _ZERO else 4 * WIDTH)
    z1 = base + (2 * WIDTH if inverse[2] < _ZERO else 5 * WIDTH)
    for k in range(WIDTH):
        ax, bx = (boxes[x0 + k] - o[0]) * inverse[0], (boxes[x1 + k] - o[0]) * inverse[0]
        ay, by = (boxes[y0 + k] - o[1]) * inverse[1], (boxes[y1 + k] - o[1]) * inverse[1]
        az, bz = (boxes[z0 + k] - o[2]) * inverse[2], (boxes[z1 + k] - o[2]) * inverse[2]
        a = max(max(ax, ay), max(az, _ZERO))
        b = min(min(bx, by), min(bz, best)) * _SLACK
        near[k] = a if a <= b else _INF


@jit(forceinline=True)
def _push(child, node, near, stack, entry, top):
    """Puts the boxes that were met on the stack, the nearest on top."""
    bottom = top
    for k in range(WIDTH):
        a = near[k]
        if a < _INF:
            j = top
            while j > bottom and entry[j - 1] < a:
                entry[j], stack[j] = entry[j - 1], stack[j - 1]
                j -= 1
            entry[j], stack[j] = a, child[node * WIDTH + k]
            top += 1
    return top


@jit(forceinline=True)
def _inside(corners, leaf, px, py, pz, kx, ky, kz, sx, sy, inside):
    """Marks which of a leaf's eight triangles the ray's line crosses; returns whether any."""
    base = leaf * 9 * WIDTH
    x, y, z = base + kx * WIDTH, base + ky * WIDTH, base + kz * WIDTH
    found = _ZERO
    for k in range(WIDTH):
        za, zb, zc = corners[z + k] - pz, corners[z + 3 * WIDTH + k] - pz, corners[z + 6 * WIDTH + k] - pz
        ax, ay = (corners[x + k] - px) - sx * za, (corners[y + k] - py) - sy * za
        bx, by = (corners[x + 3 * WIDTH + k] - px) - sx * zb, (corners[y + 3 * WIDTH + k] - py) - sy * zb
        cx, cy = (corners[x + 6 * WIDTH + k] - px) - sx * zc, (corners[y + 6 * WIDTH + k] - py) - sy * zc
        e = cx * by - cy * bx
        f = ax * cy - ay * cx
        g = bx * ay - by * ax
        both = ((e >= _ZERO) & (f >= _ZERO) & (g >= _ZERO)) | ((e <= _ZERO) & (f <= _ZERO) & (g <= _ZERO))
        mark = _ONE if both else _ZERO
        inside[k] = mark
        found = max(found, mark)
    return found > _ZERO


@jit(forceinline=True)
def _finite(a, b, c):
    return a * _ZERO + b * _ZERO + c * _ZERO == _ZERO


@jit()
def _trace(i, o, d, t_max, tree, kinds, work, any_hit):
    """The nearest hit of ray i (or any): ``t, prim, u, v``."""
    boxes, child, leaves, ids, simple, corner, rows = tree
    stack, entry, near, inside = work
    n1, n2, n3 = kinds
    p, r, best = (o[0, i], o[1, i], o[2, i]), (d[0, i], d[1, i], d[2, i]), t_max[i]
    prim, best_u, best_v = np.int32(-1), _ZERO, _ZERO
    if not (best > _ZERO and _finite(p[0], p[1], p[2]) and _finite(r[0], r[1], r[2])):
        return _INF, prim, _ZERO, _ZERO
    kx, ky, kz, sx, sy, sz, ix, iy, iz = setup(r[0], r[1], r[2])
    px, py, pz = o[kx, i], o[ky, i], o[kz, i]
    stack[0], entry[0] = 0, _ZERO
    top = 1
    while top > 0:
        top -= 1
        node = stack[top]
        if entry[top] > best * _SLACK:
            continue
        if node >= 0:
            _children(boxes, node, p, (ix, iy, iz), best, near)
            top = _push(child, node, near, stack, entry, top)
            continue
        leaf = ~node
        if simple[leaf] and not _inside(leaves, leaf, px, py, pz, kx, ky, kz, sx, sy, inside):
            continue
        for k in range(WIDTH):
            q = ids[leaf * WIDTH + k]
            if q < 0 or (simple[leaf] and inside[k] == _ZERO):
                continue
            t, u, v = distance(q, corner, rows, n1, n2, n3, p, r, kx, ky, kz, sx, sy, sz)
            if t > _ZERO and (t < best or (t == best and q < prim)):
                best, prim, best_u, best_v = t, q, u, v
                if any_hit:
                    return best, prim, best_u, best_v
    return (best if prim >= 0 else _INF), prim, best_u, best_v


@jit()
def intersect(first, last, o, d, t_max, tree, kinds, room, t, prim, u, v):
    """Nearest hits of the rays ``first <= i < last``; ``room`` is the size of the stack."""
    work = (
        np.empty(room, np.int32),
        np.empty(room, np.float32),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float32),
    )
    for i in range(first, last):
        t[i], prim[i], u[i], v[i] = _trace(i, o, d, t_max, tree, kinds, work, False)


@jit(parallel=True)
def intersect_parallel(chunks, items, o, d, t_max, tree, kinds, room, t, prim, u, v):
    """:func:`intersect` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        intersect(a, b, o, d, t_max, tree, kinds, room, t, prim, u, v)


@jit()
def occluded(first, last, o, d, t_max, tree, kinds, room, blocked):
    """Whether the rays ``first <= i < last`` hit anything."""
    work = (
        np.empty(room, np.int32),
        np.empty(room, np.float32),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float32),
    )
    for i in range(first, last):
        blocked[i] = _trace(i, o, d, t_max, tree, kinds, work, True)[1] >= 0


@jit(parallel=True)
def occluded_parallel(chunks, items, o, d, t_max, tree, kinds, room, blocked):
    """:func:`occluded` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        occluded(a, b, o, d, t_max, tree, kinds, room, blocked)
