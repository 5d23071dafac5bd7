"""Tests of one ray with a node's eight boxes or a leaf's eight triangles, and the stack of a traversal.

The layout of nodes and leaves, codes and entries are explained in :mod:`torchpt.search.tree_layout`.

Names in the traversals: ``tree`` is the buffer as float32, ``codes`` the same memory as int32, ``base`` the offset of a block
    in
it; ``ox`` to ``dz`` origin and direction of a ray, ``ix, iy, iz`` its reciprocal direction, ``sx, sy, sz`` its shear,
``px, py, pz`` its origin in the order of the sheared axes; ``best`` the distance of the nearest hit so far; ``met`` what a test
returns, beginning with the mask of what was hit. A *splat* is a number repeated in all lanes. ``scene`` is the tuple that
:func:`kernel_sources.tree_leaf.intersect_others` describes.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import inner
from kernel_sources.simd import (
    as_int,
    bits,
    item,
    lane_numbers,
    load,
    maximum,
    minimum,
    popcount,
    prefetch,
    select,
    sort_descending,
    splat,
    store,
)
from torchpt.search.tree_layout import LINE, MAY_PASS, NODE, PLANES, SLACK

__all__ = [
    "block_offset",
    "blocking",
    "boxes",
    "crossed_triangles",
    "is_valid_ray",
    "planes",
    "prefetch_block",
    "push",
    "triangles_alone",
]

_ZERO = np.float32(0.0)


@inner(forceinline=True)
def block_offset(code):
    """Return the offset, in float32, of a code's block in the buffer.

    ``code >> 63`` is 0 for a node and -1 for a leaf, whose bits the exclusive or inverts; the last two bits are the kinds.
    """
    return ((code ^ (code >> 63)) & ~3) * (LINE // 4)


@inner(forceinline=True)
def triangles_alone(code):
    """Return True if a leaf holds only triangles, by its code: ``kinds`` is 0, and inverted in the code of a leaf."""
    return code & 3 == 3


@inner(forceinline=True)
def blocking(scene, prim):
    """Return the id of a primitive if it is opaque, else :data:`MAY_PASS`.

    ``scene`` ends with one uint8 a primitive, nonzero if light may pass, and their number: 0 if all primitives are opaque.
    """
    return MAY_PASS if scene[5] > 0 and item(scene[4], prim) != 0 else prim


@inner(forceinline=True)
def is_valid_ray(ox, oy, oz, dx, dy, dz, t_max):
    """Return True if a ray can hit anything: it is finite and ``t_max > 0``."""
    zero = ox * _ZERO + oy * _ZERO + oz * _ZERO + dx * _ZERO + dy * _ZERO + dz * _ZERO
    return t_max > _ZERO and zero == _ZERO


@inner(forceinline=True)
def boxes(tree, base, nx, ny, nz, ox, oy, oz, ix, iy, iz, far):
    """Return the entries of a node's eight boxes, and the mask of those hit before ``far``.

    ``nx, ny, nz`` are the offsets in the node of the planes that the ray meets first: 0, 8, 16 for the lower x, y, z, and 24,
        32,
    40 for the upper ones. Origin, reciprocal direction and ``far`` are splats.
    """
    ax, bx = (load(tree, base + nx, 8) - ox) * ix, (load(tree, base + (24 - nx), 8) - ox) * ix
    ay, by = (load(tree, base + ny, 8) - oy) * iy, (load(tree, base + (40 - ny), 8) - oy) * iy
    az, bz = (load(tree, base + nz, 8) - oz) * iz, (load(tree, base + (56 - nz), 8) - oz) * iz
    a = maximum(maximum(ax, ay), maximum(az, splat(_ZERO, 8)))
    b = minimum(minimum(bx, by), minimum(bz, far)) * splat(SLACK, 8)
    return a, a <= b


@inner(forceinline=True)
def push(keys, parents, top, base, a, met):
    """Push the boxes that were hit on the stack, the nearest on top; return the new top.

    The stack has two rows: ``keys``, and ``parents``, the offset of the node. ``a`` are the entries and ``met`` the mask of
    :func:`boxes`. A key is the bits of an entry, which order as the numbers do, with the child's number in the last three; of a
    box that was not hit it is -1. Eight keys are always written, which avoids a branch on the number of hits.
    """
    key = select(met, (as_int(a) & splat(np.int32(-8), 8)) | lane_numbers(8), splat(np.int32(-1), 8))
    store(keys, top, sort_descending(key))
    store(parents, top, splat(np.int32(base), 8))
    return top + popcount(bits(met))


@inner(forceinline=True)
def crossed_triangles(tree, base, kx, ky, kz, px, py, pz, sx, sy):
    """Return the mask of a leaf's triangles that the ray's line crosses, corners' depths, two edge functions, determinant.

    Edge functions of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013), without any tolerance. Origin
    and shear are splats, their axes in the order of :func:`kernel_sources.tree_leaf.setup_ray`.
    """
    x, y, z = base + kx * 8, base + ky * 8, base + kz * 8
    za, zb, zc = load(tree, z, 8) - pz, load(tree, z + 24, 8) - pz, load(tree, z + 48, 8) - pz
    ax, ay = (load(tree, x, 8) - px) - sx * za, (load(tree, y, 8) - py) - sy * za
    bx, by = (load(tree, x + 24, 8) - px) - sx * zb, (load(tree, y + 24, 8) - py) - sy * zb
    cx, cy = (load(tree, x + 48, 8) - px) - sx * zc, (load(tree, y + 48, 8) - py) - sy * zc
    e, f, g = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    low, high = minimum(minimum(e, f), g), maximum(maximum(e, f), g)
    det, zero = e + f + g, splat(_ZERO, 8)
    return ((low >= zero) | (high <= zero)) & (det != zero), za, zb, zc, f, g, det


@inner(forceinline=True)
def planes(tree, base, o, d, za, zb, zc, sz, floor):
    """Return ``t`` of a leaf's planes, clamped to the corners' depths and to at least ``floor``, and the mask of positive ones.

    ``za, zb, zc`` are the depths that :func:`crossed_triangles` returns; ``o``, ``d`` are tuples, ``sz`` is a splat.
    """
    zero = splat(_ZERO, 8)
    n0, n1, n2 = load(tree, base + PLANES, 8), load(tree, base + PLANES + 8, 8), load(tree, base + PLANES + 16, 8)
    away = n0 * splat(o[0], 8) + n1 * splat(o[1], 8) + n2 * splat(o[2], 8) + load(tree, base + PLANES + 24, 8)
    along = n0 * splat(d[0], 8) + n1 * splat(d[1], 8) + n2 * splat(d[2], 8)
    plane = -away / along
    za, zb, zc = za * sz, zb * sz, zc * sz
    t = minimum(maximum(plane, minimum(minimum(za, zb), zc)), maximum(maximum(za, zb), zc))
    return maximum(t, splat(floor, 8)), (plane == plane) & (t > zero)


@inner(forceinline=True)
def prefetch_block(tree, code):
    """Prefetch the cache lines of a block.

    Nodes and leaves share one path with computed addresses: a branch would be mispredicted as often as the one that follows.
    The ids of a leaf are left out, as few rays read them.
    """
    leaf = code >> 63
    base = ((code ^ leaf) & ~3) * (LINE // 4)
    rest = base + (leaf & (NODE * LINE))
    prefetch(tree, base)
    prefetch(tree, base + LINE)
    prefetch(tree, base + 2 * LINE)
    prefetch(tree, base + 3 * LINE)
    prefetch(tree, rest)
    prefetch(tree, rest + LINE)
    prefetch(tree, rest + 2 * LINE)
