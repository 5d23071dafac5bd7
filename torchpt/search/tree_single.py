"""One ray through a tree from one of its nodes (numba): for trees below trees, where rays meet few boxes together."""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit_internal
from torchpt.native.simd import as_float, bits, item, splat, store, trailing_zeros
from torchpt.search.tree_layout import (
    CHILDREN,
    FLOOR,
    IDS,
    SLACK,
    block_offset,
    blocking,
    boxes,
    crossed_triangles,
    planes,
    push,
)
from torchpt.search.tree_leaf import setup_ray

__all__ = ["SCRATCH", "nearest_triangle", "occluding_triangle", "pop", "trace_single"]

_ZERO = np.float32(0.0)
#: Numbers of a kernel's scratch row: ``t``, ``u``, ``v`` of eight triangles.
SCRATCH = 24


@jit_internal(forceinline=True)
def pop(codes, keys, parents, top, bottom, limit):
    """The next box that is entered before ``limit``: top of the stack (below ``bottom`` if there is none), code, key."""
    code, key = np.int64(0), np.int32(0)
    while True:
        top -= 1
        if top < bottom:
            break
        key = item(keys, top)
        if as_float(key & np.int32(-8)) <= limit:
            code = np.int64(item(codes, np.int64(item(parents, top)) + CHILDREN + np.int64(key & np.int32(7))))
            break
    return top, code, key


@jit_internal(forceinline=True)
def nearest_triangle(tree, codes, base, met, sz, o, d, floor, best, prim, shift, scratch):
    """The nearest of a leaf's triangles that :func:`crossed_triangles` has found.

    Returns ``best``, ``prim`` (ids count from ``shift``) and the lane of ``scratch`` where u and v are, -1 where no triangle is
    nearer than what came in.
    """
    m, za, zb, zc, f, g, det = met
    lane = np.int64(-1)
    t, ahead = planes(tree, base, o, d, za, zb, zc, splat(sz, 8), floor)
    w = bits(m & ahead & (t <= splat(best, 8)))
    if w != 0:
        store(scratch, 0, t)
        store(scratch, 8, f / det)
        store(scratch, 16, g / det)
        while w != 0:
            k = trailing_zeros(w)
            w &= w - 1
            near, q = item(scratch, k), np.int32(item(codes, base + IDS + k) + shift)
            if near < best or (near == best and q < prim):
                best, prim, lane = near, q, k
    return best, prim, lane


@jit_internal(forceinline=True)
def occluding_triangle(scene, base, met, sz, o, d, floor, best, prim, shift):
    """The id of a triangle that :func:`crossed_triangles` has found and that lets no light pass; else :data:`MAY_PASS` or ``prim``."""
    tree, codes = scene[0], scene[1]
    t, ahead = planes(tree, base, o, d, met[1], met[2], met[3], splat(sz, 8), floor)
    w = bits(met[0] & ahead & (t < splat(best, 8)))
    while w != 0:
        prim = blocking(scene, np.int32(item(codes, base + IDS + trailing_zeros(w)) + shift))
        w = 0 if prim >= 0 else w & (w - 1)
    return prim


@jit_internal()
def trace_single(scene, root, o, d, best, prim, shift, keys, parents, bottom, scratch, any_hit):
    """The nearest hit of a ray below a node of triangles alone where it is nearer than ``best``, or any such hit.

    Args:
        scene: the buffer, the same as int32; and as :func:`torchpt.search.tree_layout.blocking` takes it.
        root: the node's code.
        o: origin, a tuple.
        d: direction.
        best: distance of the best hit so far, or where the ray ends.
        prim: its id, or -1.
        shift: added to the ids below the node.
        keys: the stack.
        parents: the stack.
        bottom: where this call's part of the stack begins.
        scratch: ``(SCRATCH,)`` float32.
        any_hit: whether any hit will do.

    Returns:
        ``t, prim, u, v``; ``u`` and ``v`` mean nothing where ``prim`` is the one that came in.
    """
    tree, codes = scene[0], scene[1]
    kx, ky, kz, sx, sy, sz, ix, iy, iz = setup_ray(d[0], d[1], d[2])
    px, py, pz = splat(o[kx], 8), splat(o[ky], 8), splat(o[kz], 8)
    nx, ny, nz = 0 if ix > _ZERO else 24, 8 if iy > _ZERO else 32, 16 if iz > _ZERO else 40
    ox, oy, oz, vx, vy, vz = (
        splat(o[0], 8), splat(o[1], 8), splat(o[2], 8), splat(ix, 8), splat(iy, 8), splat(iz, 8),
    )  # fmt: skip
    u, v = _ZERO, _ZERO
    top, code, key = np.int64(bottom), np.int64(root), np.int32(0)
    while top >= bottom:
        base = block_offset(code)
        if code >= 0:
            a, met = boxes(tree, base, nx, ny, nz, ox, oy, oz, vx, vy, vz, splat(best, 8))
            top = push(keys, parents, top, base, a, met)
        else:
            met = crossed_triangles(tree, base, kx, ky, kz, px, py, pz, splat(sx, 8), splat(sy, 8))
            if bits(met[0]) != 0:
                floor = as_float(key & np.int32(-8)) * FLOOR
                if any_hit:
                    prim = occluding_triangle(scene, base, met, sz, o, d, floor, best, prim, shift)
                    if prim >= 0:
                        break
                else:
                    best, prim, lane = nearest_triangle(
                        tree, codes, base, met, sz, o, d, floor, best, prim, shift, scratch
                    )
                    if lane >= 0:
                        u, v = item(scratch, 8 + lane), item(scratch, 16 + lane)
        top, code, key = pop(codes, keys, parents, top, bottom, best * SLACK)
    return best, prim, u, v
