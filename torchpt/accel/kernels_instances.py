"""Traversal of the copies (numba): a tree over their boxes, and for each that is met the tree of its mesh."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.kernels_build import WIDTH
from torchpt.accel.kernels_leaf import distance, setup
from torchpt.accel.kernels_wide import LOWEST, SLACK, children, finite, inside, push
from torchpt.native.jit import jit

__all__ = ["trace", "trace_parallel"]

_ZERO = np.float32(0.0)


@jit()
def _mesh(root, tree, o, d, best, prim, shift, near, stack, entry, bottom, unit, any_hit):
    """The nearest hit of a ray in one mesh's tree where that is nearer than ``best``: ``t``, id, ``u``, ``v``; else id -1."""
    boxes, child, leaves, ids, full, corner, rows, quadrics = tree
    kx, ky, kz, sx, sy, sz, ix, iy, iz = setup(d[0], d[1], d[2])
    px, py, pz = o[kx], o[ky], o[kz]
    best_u, best_v, found = _ZERO, _ZERO, np.int32(-1)
    most = corner.shape[0]
    stack[bottom], entry[bottom] = root, _ZERO
    top = bottom + 1
    while top > bottom:
        top -= 1
        node = stack[top]
        if entry[top] > best * SLACK:
            continue
        if node >= 0:
            met = children(boxes, node, o, (ix, iy, iz), best, near, unit)
            top = push(child, node, met, near, stack, entry, top)
            continue
        leaf = ~node
        left = full[leaf]
        if left < 0:
            left = inside(leaves, leaf, px, py, pz, kx, ky, kz, sx, sy, unit)
        while left != 0:
            q = ids[leaf * WIDTH + LOWEST[left]]
            left &= left - np.int32(1)
            t, u, v = distance(q, corner, rows, quadrics, most, most, most, most, o, d, kx, ky, kz, sx, sy, sz)
            if t > _ZERO and (t < best or (t == best and q + shift < prim)):
                best, prim, best_u, best_v = t, np.int32(q + shift), u, v
                found = prim
                if any_hit:
                    return best, found, best_u, best_v
    return best, found, best_u, best_v


@jit()
def trace(first, last, o, d, t_max, upper, lower, table, shift, roots, room, unit, any_hit, t, prim, u, v):
    """Takes the copies into the hits of the rays ``first <= i < last``.

    Args:
        first: ray.
        last: ray.
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        t_max: ``(N,)``.
        upper: boxes, children and ids of the tree over the copies.
        lower: the trees of all meshes, one after the other; see :class:`torchpt.accel.wide.Wide`.
        table: ``(I, 12)`` float64 maps from the world to the meshes.
        shift: ``(I,)`` from a triangle's row to its id in the copy.
        roots: ``(I,)`` nodes where their trees begin.
        room: entries on the stack.
        unit: 1, see :func:`torchpt.accel.kernels_wide.intersect`.
        any_hit: whether any hit will do; rays that have one are left alone.
        t: found so far, inf for none.
        prim: found so far, -1 for none.
        u: found so far.
        v: found so far.
    """
    boxes, child, ids = upper
    stack, entry = np.empty(room, np.int32), np.empty(room, np.float32)
    near = np.empty(WIDTH, np.float32)
    for i in range(first, last):
        p, r = (o[0, i], o[1, i], o[2, i]), (d[0, i], d[1, i], d[2, i])
        if not (t_max[i] > _ZERO and finite(p[0], p[1], p[2]) and finite(r[0], r[1], r[2])):
            continue
        if any_hit and prim[i] >= 0:
            continue
        best = min(t[i], t_max[i])
        _, _, _, _, _, _, ix, iy, iz = setup(r[0], r[1], r[2])
        stack[0], entry[0] = 0, _ZERO
        top = 1
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
            for k in range(WIDTH):
                c = ids[leaf * WIDTH + k]
                if c < 0:
                    continue
                px, py, pz = np.float64(p[0]), np.float64(p[1]), np.float64(p[2])
                rx, ry, rz = np.float64(r[0]), np.float64(r[1]), np.float64(r[2])
                at = (
                    np.float32(table[c, 0] * px + table[c, 1] * py + table[c, 2] * pz + table[c, 3]),
                    np.float32(table[c, 4] * px + table[c, 5] * py + table[c, 6] * pz + table[c, 7]),
                    np.float32(table[c, 8] * px + table[c, 9] * py + table[c, 10] * pz + table[c, 11]),
                )
                along = (
                    np.float32(table[c, 0] * rx + table[c, 1] * ry + table[c, 2] * rz),
                    np.float32(table[c, 4] * rx + table[c, 5] * ry + table[c, 6] * rz),
                    np.float32(table[c, 8] * rx + table[c, 9] * ry + table[c, 10] * rz),
                )
                distance_, found, a, b = _mesh(
                    roots[c], lower, at, along, best, prim[i], shift[c], near, stack, entry, top, unit, any_hit
                )
                if found >= 0:
                    best = distance_
                    t[i], prim[i], u[i], v[i] = best, found, a, b
                    if any_hit:
                        top = 0
                        break


@jit(parallel=True)
def trace_parallel(chunks, items, o, d, t_max, upper, lower, table, shift, roots, room, unit, any_hit, t, prim, u, v):
    """:func:`trace` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        first, last = c * items // chunks, (c + 1) * items // chunks
        trace(first, last, o, d, t_max, upper, lower, table, shift, roots, room, unit, any_hit, t, prim, u, v)
