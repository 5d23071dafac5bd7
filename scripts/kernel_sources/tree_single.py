"""Traverse a tree of triangles from one of its nodes by a single ray: the lower level of instances.

For the names of values see :mod:`kernel_sources.tree_nodes`.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import inner
from kernel_sources.simd import as_float, bits, item, splat, store, trailing_zeros
from kernel_sources.tree_leaf import setup_ray
from kernel_sources.tree_nodes import block_offset, blocking, boxes, crossed_triangles, planes, push
from torchpt.search.tree_layout import CHILDREN, FLOOR, IDS, SLACK

__all__ = ["SCRATCH", "nearest_triangle", "occluding_triangle", "pop", "trace_single"]

_ZERO = np.float32(0.0)
#: Length of a kernel's scratch row: ``t``, ``u``, ``v`` of eight triangles.
SCRATCH = 24


@inner(forceinline=True)
def pop(codes, keys, parents, top, bottom, limit):
    """Pop the next box with an entry of at most ``limit``; return top of the stack, code of the child, key.

    The top is below ``bottom`` if no such box is left. ``keys``, ``parents``: see :func:`kernel_sources.tree_nodes.push`.
    """
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


@inner(forceinline=True)
def nearest_triangle(tree, codes, base, met, sz, o, d, floor, best, prim, shift, scratch):
    """Update the nearest hit by a leaf's triangles; ``met`` is the result of :func:`crossed_triangles` for the leaf.

    Returns ``best``, ``prim`` (ids plus ``shift``) and the lane of ``scratch`` that holds u and v, -1 if no triangle is nearer.
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


@inner(forceinline=True)
def occluding_triangle(scene, base, met, sz, o, d, floor, best, prim, shift):
    """Return the id of an opaque triangle of the leaf that the ray hits before ``best``.

    Else :data:`MAY_PASS` if it hits one that may let light pass, or ``prim``. ``met``: see :func:`nearest_triangle`.
    """
    tree, codes = scene[0], scene[1]
    t, ahead = planes(tree, base, o, d, met[1], met[2], met[3], splat(sz, 8), floor)
    w = bits(met[0] & ahead & (t < splat(best, 8)))
    while w != 0:
        prim = blocking(scene, np.int32(item(codes, base + IDS + trailing_zeros(w)) + shift))
        w = 0 if prim >= 0 else w & (w - 1)
    return prim


@inner()
def trace_single(scene, root, o, d, best, prim, shift, keys, parents, bottom, scratch, any_hit):
    """Find the nearest hit of a ray in a subtree of triangles, nearer than ``best``, or any such hit.

    Args:
        scene: the tree as float32 and as int32, and the tables of :func:`kernel_sources.tree_nodes.blocking`.
        root: code of the node.
        o: origin, a tuple.
        d: direction.
        best: distance of the nearest hit so far, or ``t_max`` of the ray.
        prim: id of that hit, or -1.
        shift: added to the ids of the subtree.
        keys: keys of the stack.
        parents: parent nodes of the stack.
        bottom: first free entry of the stack.
        scratch: ``(SCRATCH,)`` float32.
        any_hit: True: stop at the first opaque hit.

    Returns:
        ``t, prim, u, v``; ``u`` and ``v`` are undefined if ``prim`` has not changed.
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
