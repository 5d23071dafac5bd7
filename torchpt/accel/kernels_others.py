"""One ray against the primitives of a leaf that are no triangles (numba): eight rectangles at once, others one by one."""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import IDS, LEAF, LINE, blocking
from torchpt.accel.kernels_leaf import distance
from torchpt.native.jit import part
from torchpt.native.simd import absolute, bits, item, load, maximum, minimum, splat, store, trailing_zeros

__all__ = ["FOURTH", "RECTANGLES", "RULED", "others"]

#: Where the rectangles of a leaf begin: three corners as in a leaf, then the fourth ones, then planes.
RECTANGLES = LEAF * LINE
FOURTH, RULED = 72, 96
_ZERO = np.float32(0.0)


@part(forceinline=True)
def _corner(tree, at, axes, p, s):
    """A corner of eight rectangles in the ray's sheared place; see :func:`torchpt.accel.kernels_blocks.crossed`."""
    z = load(tree, at + axes[2] * 8, 8) - p[2]
    x = (load(tree, at + axes[0] * 8, 8) - p[0]) - s[0] * z
    return x, (load(tree, at + axes[1] * 8, 8) - p[1]) - s[1] * z, z * s[2]


@part(forceinline=True)
def _rectangles(tree, at, axes, o, d, p, s):
    """Eight rectangles: which are met, ``t``, u and v; the operations of :func:`torchpt.accel.leaf.rectangle_hits`."""
    zero = splat(_ZERO, 8)
    n0, n1 = load(tree, at + RULED, 8), load(tree, at + RULED + 8, 8)
    n2, n3 = load(tree, at + RULED + 16, 8), load(tree, at + RULED + 24, 8)
    away = n0 * splat(o[0], 8) + n1 * splat(o[1], 8) + n2 * splat(o[2], 8) + n3
    along = n0 * splat(d[0], 8) + n1 * splat(d[1], 8) + n2 * splat(d[2], 8)
    plane = -away / along
    ax, ay, az = _corner(tree, at, axes, p, s)
    bx, by, bz = _corner(tree, at + 24, axes, p, s)
    cx, cy, cz = _corner(tree, at + 48, axes, p, s)
    qx, qy, qz = _corner(tree, at + FOURTH, axes, p, s)
    f, g = ax * cy - ay * cx, bx * ay - by * ax
    h, k = qx * by - qy * bx, cx * qy - cy * qx
    low, high = minimum(minimum(f, g), minimum(h, k)), maximum(maximum(f, g), maximum(h, k))
    det = minimum(absolute(f + h), absolute(g + k))  # a product would be the fourth power of a length
    met = ((low >= zero) | (high <= zero)) & (det != zero) & (plane == plane)
    near, far = minimum(minimum(minimum(az, bz), cz), qz), maximum(maximum(maximum(az, bz), cz), qz)
    t = minimum(maximum(plane, near), far)
    return met & (t > zero), t, f / (f + h), g / (g + k)


@part()
def others(scene, code, base, o, d, axes, shear, floor, best, prim, scratch, any_hit):
    """The best hit so far of one ray after a leaf's primitives that are no triangles, with ``u`` and ``v``.

    Args:
        scene: the tree as float32 and as int32; corners, affine rows and quadrics of all primitives but triangles; ids of the
            first rectangle, disk, sphere and quadric; what :func:`torchpt.accel.kernels_blocks.blocking` takes.
        code: the leaf's.
        base: where the leaf begins.
        o: origin.
        d: direction.
        axes: order of the axes.
        shear: see :func:`torchpt.accel.kernels_leaf.setup`.
        floor: least distance of a hit here.
        best: the best distance so far.
        prim: its primitive, or -1; of any hit see :func:`torchpt.accel.kernels_blocks.blocking`.
        scratch: 24 float32.
        any_hit: stop at the first hit that blocks; the rest of what is returned means nothing then.

    Returns:
        ``best, prim, u, v``; the last two mean nothing where ``prim`` is the one that came in.
    """
    tree, codes, tables, kinds = scene[0], scene[1], scene[2], scene[3]
    u, v = _ZERO, _ZERO
    if code & 2 == 0:
        p = (splat(o[axes[0]], 8), splat(o[axes[1]], 8), splat(o[axes[2]], 8))
        s = (splat(shear[0], 8), splat(shear[1], 8), splat(shear[2], 8))
        met, t, a, b = _rectangles(tree, base + RECTANGLES, axes, o, d, p, s)
        t = maximum(t, splat(floor, 8))
        left = bits(met & (t <= splat(best, 8)))
        if left != 0:
            store(scratch, 0, t)
            store(scratch, 8, a)
            store(scratch, 16, b)
        while left != 0:
            k = trailing_zeros(left)
            left &= left - 1
            near, q = item(scratch, k), np.int32(-2 - item(codes, base + IDS + k))
            if any_hit:
                if near < best:
                    prim = blocking(scene, q)
                    if prim >= 0:
                        return best, prim, u, v
            elif near < best or (near == best and q < prim):
                best, prim, u, v = near, q, item(scratch, 8 + k), item(scratch, 16 + k)
    if code & 1 == 0:
        first, disk, sphere, quadric = item(kinds, 0), item(kinds, 1), item(kinds, 2), item(kinds, 3)
        for k in range(8):
            q = np.int32(-2 - item(codes, base + IDS + k))
            if q < disk:  # a triangle's or an empty place is below 0
                continue
            t, a, b = distance(
                q - first, tables[0], tables[1], tables[2], disk - first, sphere - first, quadric - first, o, d
            )
            if not t > _ZERO:
                continue
            t = max(t, floor)
            if any_hit:
                if t < best:
                    prim = blocking(scene, q)
                    if prim >= 0:
                        break
            elif t < best or (t == best and q < prim):
                best, prim, u, v = t, q, a, b
    return best, prim, u, v
