"""The CPU tree's search in the plainest form: one ray, one box and one triangle at a time, in scalar arithmetic."""

import math

import numba
import numpy as np
import torch

from torchpt.search.tree_build import mesh_tree
from torchpt.search.tree_layout import FLOOR, SLACK

ZERO, INF = np.float32(0), np.float32(np.inf)


@numba.njit(error_model="numpy")
def _enter(box, base, k, o, inverse, far):
    """Entry into a child's box, or NaN where it is not met before ``far``."""
    a, b = ZERO, far
    for c in (2, 1, 0):
        near, beyond = box[base + c * 8 + k], box[base + 24 + c * 8 + k]
        if inverse[c] < ZERO:
            near, beyond = beyond, near
        a, b = max(a, (near - o[c]) * inverse[c]), min(b, (beyond - o[c]) * inverse[c])
    return a if a <= b * SLACK else np.float32(np.nan)


@numba.njit(error_model="numpy")
def _triangle(p, row, o, d, axes):
    """``t, u, v`` by Woop's edge functions and the plane's distance; ``t`` is NaN for a miss."""
    x, y, z = axes
    sx, sy, sz = d[x] / d[z], d[y] / d[z], np.float32(1) / d[z]
    q = np.empty((3, 3), np.float32)
    for k in range(3):
        q[k, 2] = p[k, z] - o[z]
        q[k, 0] = (p[k, x] - o[x]) - sx * q[k, 2]
        q[k, 1] = (p[k, y] - o[y]) - sy * q[k, 2]
    e = q[2, 0] * q[1, 1] - q[2, 1] * q[1, 0]
    f = q[0, 0] * q[2, 1] - q[0, 1] * q[2, 0]
    g = q[1, 0] * q[0, 1] - q[1, 1] * q[0, 0]
    det = e + f + g
    inside = (e >= 0 and f >= 0 and g >= 0) or (e <= 0 and f <= 0 and g <= 0)
    away = row[0] * o[0] + row[1] * o[1] + row[2] * o[2] + row[3]
    plane = -away / (row[0] * d[0] + row[1] * d[1] + row[2] * d[2])
    if not (inside and det != 0 and plane == plane):
        return np.float32(np.nan), ZERO, ZERO
    a, b, c = q[0, 2] * sz, q[1, 2] * sz, q[2, 2] * sz
    return min(max(plane, min(min(a, b), c)), max(max(a, b), c)), f / det, g / det


@numba.njit(error_model="numpy")
def _trace(o, d, t_max, box, child, ids, p, rows, t, prim, u, v):
    stack, entries = np.empty(4096, np.int64), np.empty(4096, np.float32)
    for i in range(len(t_max)):
        a, b, best = o[:, i].copy(), d[:, i].copy(), t_max[i]
        t[i], prim[i], u[i], v[i] = INF, -1, 0, 0
        if not (best > 0 and np.isfinite(a).all() and np.isfinite(b).all()):
            continue
        size = np.abs(b)
        z = 0 if size[0] >= size[1] and size[0] >= size[2] else (1 if size[1] >= size[2] else 2)
        axes = ((z + 1) % 3, (z + 2) % 3, z)
        least = max(size[z] * np.float32(1e-20), np.float32(1e-37))
        inverse = np.empty(3, np.float32)
        for c in range(3):
            inverse[c] = np.float32(1) / (b[c] if size[c] >= least else np.float32(math.copysign(least, b[c])))
        stack[0], entries[0], top = 0, 0, 1
        while top:  # in no particular order: which boxes are met first makes no difference
            top -= 1
            node, entry = stack[top], entries[top]
            if node >= 0:
                for k in range(8):
                    near = _enter(box, node * 48, k, a, inverse, best)
                    if child[node * 8 + k] != 0 and near == near:
                        stack[top], entries[top] = child[node * 8 + k], near
                        top += 1
                continue
            # the entry without its last three bits, as it is where entries are sorted
            floor = (np.array([entry]).view(np.int32) & -8).view(np.float32)[0] * FLOOR
            for k in range(8):
                q = ids[~node * 8 + k]
                if q < 0:
                    break
                s, x, y = _triangle(p[q], rows[q], a, b, axes)
                if not s > 0:
                    continue
                s = max(s, floor)
                if s < best or (s == best and q < prim[i]):
                    best, prim[i], t[i], u[i], v[i] = s, q, s, x, y


def scalar_search(g, o, d, t_max):
    """``t, prim, u, v`` of rays in a geometry of triangles, arrays of numpy."""
    tree, rows, _ = mesh_tree(g)
    p = torch.stack((g.p0, g.p1, g.p2)).permute(2, 0, 1).contiguous().numpy()
    t, u, v = np.empty((3, len(t_max)), np.float32)
    prim = np.empty(len(t_max), np.int32)
    _trace(o, d, t_max, tree.boxes, tree.child, tree.ids, p, rows, t, prim, u, v)
    return t, prim, u, v
