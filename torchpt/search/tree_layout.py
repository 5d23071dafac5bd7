"""A tree in blocks of cache lines (numba), and one ray against the eight boxes or the eight triangles of a block.

Everything lies in one buffer of 64-byte lines of 16 float32. A *node* is 4 lines: the lower x, y, z and the upper x, y, z
of eight children, their eight codes, eight numbers not used. A *leaf* is 7 lines: the nine components of eight
triangles' corners, their planes' four numbers, eight ids. A leaf that holds rectangles has 8 lines more: the twelve
components of eight corners and fourth corners, their planes. The leaves of a node follow it.

A *code* is ``4 line`` for a node and ``~(4 line + kinds)`` for a leaf, where ``kinds`` is 2 for rectangles plus 1 for
primitives of other kinds. A primitive that is no triangle has NaN for corners and ``-2 - id`` for an id; empty places have
NaN and -1.

An *entry* is the distance at which a ray enters a box. Every hit in a leaf is taken to lie at ``FLOOR`` times its leaf's
entry or beyond, and boxes are passed over only from ``SLACK`` times the best hit on. Boxes within boxes are entered no
earlier, rounding included, so the hit found does not depend on the order in which boxes are visited, nor on the rays
beside it in a packet. Entries lose their last three bits where they are sorted; ``FLOOR`` and ``SLACK`` leave room for it.
"""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import jit_internal
from torchpt.native.simd import (
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

__all__ = [
    "CHILDREN",
    "FLOOR",
    "IDS",
    "LEAF",
    "LINE",
    "MAY_PASS",
    "MORE",
    "NODE",
    "PLANES",
    "SLACK",
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

LINE = 16  # float32 numbers a cache line
NODE, LEAF, MORE = 4, 7, 8  # lines of a node, of a leaf, and of the rectangles that it holds
CHILDREN = 48  # where a node's codes begin
PLANES, IDS = 72, 104  # where a leaf's planes and ids begin
SLACK = np.float32(1.0 + 2.0**-16)
FLOOR = np.float32(1.0 - 2.0**-17)
#: In place of an id: an any-hit ray has met surfaces that may let light pass, and no others yet.
MAY_PASS = np.int32(-2)
_ZERO = np.float32(0.0)


@jit_internal(forceinline=True)
def block_offset(code):
    """Where a code's block begins in the buffer."""
    return ((code ^ (code >> 63)) & ~3) * (LINE // 4)


@jit_internal(forceinline=True)
def triangles_alone(code):
    """Whether a leaf's code says that it holds nothing else."""
    return code & 3 == 3


@jit_internal(forceinline=True)
def blocking(scene, prim):
    """The id of a primitive that any-hit rays end at, or :data:`MAY_PASS`.

    ``scene`` ends with a uint8 for each primitive, not 0 where light may pass, and how many there are: none where all block.
    """
    return MAY_PASS if scene[5] > 0 and item(scene[4], prim) != 0 else prim


@jit_internal(forceinline=True)
def is_valid_ray(ox, oy, oz, dx, dy, dz, t_max):
    """Whether a ray can hit anything: finite, and ``t_max > 0``."""
    zero = ox * _ZERO + oy * _ZERO + oz * _ZERO + dx * _ZERO + dy * _ZERO + dz * _ZERO
    return t_max > _ZERO and zero == _ZERO


@jit_internal(forceinline=True)
def boxes(tree, base, nx, ny, nz, ox, oy, oz, ix, iy, iz, far):
    """Entries of a node's eight boxes, and the mask of those met before ``far``.

    ``nx, ny, nz`` say where the planes that face the ray begin; origin, reciprocal direction and ``far`` are splats.
    """
    ax, bx = (load(tree, base + nx, 8) - ox) * ix, (load(tree, base + (24 - nx), 8) - ox) * ix
    ay, by = (load(tree, base + ny, 8) - oy) * iy, (load(tree, base + (40 - ny), 8) - oy) * iy
    az, bz = (load(tree, base + nz, 8) - oz) * iz, (load(tree, base + (56 - nz), 8) - oz) * iz
    a = maximum(maximum(ax, ay), maximum(az, splat(_ZERO, 8)))
    b = minimum(minimum(bx, by), minimum(bz, far)) * splat(SLACK, 8)
    return a, a <= b


@jit_internal(forceinline=True)
def push(keys, parents, top, base, a, met):
    """Puts the boxes that were met on the stack, the nearest on top; returns the new top.

    A key is an entry whose last three bits are the child's place. Eight are always written: there is no branch that
    depends on how many were met.
    """
    key = select(met, (as_int(a) & splat(np.int32(-8), 8)) | lane_numbers(8), splat(np.int32(-1), 8))
    store(keys, top, sort_descending(key))
    store(parents, top, splat(np.int32(base), 8))
    return top + popcount(bits(met))


@jit_internal(forceinline=True)
def crossed_triangles(tree, base, kx, ky, kz, px, py, pz, sx, sy):
    """Which of a leaf's triangles the ray's line crosses, the corners' depths, and what ``u`` and ``v`` come from.

    Edge functions of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection" (2013), without any tolerance. Origin
    and shear are splats, in the order of the axes that the ray's direction asks for.
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


@jit_internal(forceinline=True)
def planes(tree, base, o, d, za, zb, zc, sz, floor):
    """``t`` of a leaf's planes, held within the corners' depths and beyond ``floor``; and where it is a distance."""
    zero = splat(_ZERO, 8)
    n0, n1, n2 = load(tree, base + PLANES, 8), load(tree, base + PLANES + 8, 8), load(tree, base + PLANES + 16, 8)
    away = n0 * splat(o[0], 8) + n1 * splat(o[1], 8) + n2 * splat(o[2], 8) + load(tree, base + PLANES + 24, 8)
    along = n0 * splat(d[0], 8) + n1 * splat(d[1], 8) + n2 * splat(d[2], 8)
    plane = -away / along
    za, zb, zc = za * sz, zb * sz, zc * sz
    t = minimum(maximum(plane, minimum(minimum(za, zb), zc)), maximum(maximum(za, zb), zc))
    return maximum(t, splat(floor, 8)), (plane == plane) & (t > zero)


@jit_internal(forceinline=True)
def prefetch_block(tree, code):
    """Asks for the lines of a block.

    Nodes and leaves take one path with computed addresses: a branch would be mispredicted as often as the one that
    follows. The ids of a leaf are left out, which few rays look at.
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
