"""Traverse a wide tree by packets of sixteen rays, and by single rays where rays are not coherent.

Rays are loaded sixteen at a time to columns of memory (:func:`load_rays`). If they are *coherent*, of one octant of directions,
they are traced as a packet at once; else they stay in their columns, until these are full and all of them are traced as
interleaved single rays. For the names of values see :mod:`kernel_sources.tree_nodes`.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import BYTES, FLOATS, INT, INTS, LONGS, inner, kernel
from kernel_sources.simd import (
    absolute,
    as_float,
    as_int,
    bits,
    highest,
    item,
    load,
    load_pointer,
    lowest,
    mask,
    maximum,
    minimum,
    part,
    popcount,
    put,
    select,
    splat,
    store,
    trailing_zeros,
)
from kernel_sources.tree_leaf import intersect_others, rectangle_hits
from kernel_sources.tree_nodes import (
    block_offset,
    blocking,
    boxes,
    crossed_triangles,
    prefetch_block,
    push,
    triangles_alone,
)
from kernel_sources.tree_single import SCRATCH, nearest_triangle, occluding_triangle, pop
from torchpt.search.tree_layout import (
    CHILDREN,
    FLOOR,
    FOURTH,
    IDS,
    MAY_PASS,
    PACKET_MEMORY,
    PLANES,
    RAYS_IN_FLIGHT,
    RECTANGLES,
    RULED,
    SLACK,
)

__all__ = ["nearest", "occluded"]


# ---- Rays in rows of memory, sixteen of them loaded at a time


#: Length of a row: most rays that are held at a time.
COLUMNS = 256
#: Rows of float32: origin, direction, reciprocal direction, shear, best distance (-1: the ray is finished), u, v.
ORIGIN, DIRECTION, INVERSE, SHEAR, BEST, U, V = (k * COLUMNS for k in (0, 3, 6, 9, 12, 13, 14))
FLOATS_OF_RAYS = 15 * COLUMNS
#: Rows of int32: axes (the longest of the direction last), offsets of the near planes, primitive hit.
AXIS, NEAR, RAY_IDS = 0, 3 * COLUMNS, 6 * COLUMNS
INTS_OF_RAYS = 7 * COLUMNS
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST, _TINY = np.float32(1e-20), np.float32(1e-37)  # as in tree_leaf.setup


@inner(forceinline=True)
def _inverse(d, least):
    """Compute reciprocals that are never infinite."""
    sign = as_int(d) & splat(np.int32(-(2**31)), 16)
    return splat(_ONE, 16) / select(absolute(d) >= least, d, as_float(as_int(least) | sign))


@inner(forceinline=True)
def _facing(inverse, at):
    """Return the offset in a node of the planes that rays meet first: ``at`` for the lower ones, 24 more for the upper ones."""
    return select(inverse > splat(_ZERO, 16), splat(np.int32(at), 16), splat(np.int32(at + 24), 16))


@inner(forceinline=True)
def load_rays(i, rays, c, rows, ids):
    """Fill columns ``c`` to ``c + 15`` with rays ``i`` to ``i + 15``; return the mask of those that can hit anything.

    ``rays`` are origins, directions, ends and the length of their rows. The operations are those of
    :func:`kernel_sources.tree_leaf.setup_ray`.
    """
    o, d, t_max, n = rays
    ox, oy, oz = load(o, i, 16), load(o, n + i, 16), load(o, 2 * n + i, 16)
    dx, dy, dz = load(d, i, 16), load(d, n + i, 16), load(d, 2 * n + i, 16)
    best, zero = load(t_max, i, 16), splat(_ZERO, 16)
    sum_ = ox * zero + oy * zero + oz * zero + dx * zero + dy * zero + dz * zero
    good = (best > zero) & (sum_ == zero)
    x, y, z = absolute(dx), absolute(dy), absolute(dz)
    first, second = (x >= y) & (x >= z), y >= z
    ex = select(first, dy, select(second, dz, dx))
    ey = select(first, dz, select(second, dx, dy))
    ez = select(first, dx, select(second, dy, dz))
    least = maximum(absolute(ez) * splat(_LEAST, 16), splat(_TINY, 16))
    rx, ry, rz = _inverse(dx, least), _inverse(dy, least), _inverse(dz, least)
    store(rows, ORIGIN + c, ox)
    store(rows, ORIGIN + COLUMNS + c, oy)
    store(rows, ORIGIN + 2 * COLUMNS + c, oz)
    store(rows, DIRECTION + c, dx)
    store(rows, DIRECTION + COLUMNS + c, dy)
    store(rows, DIRECTION + 2 * COLUMNS + c, dz)
    store(rows, INVERSE + c, rx)
    store(rows, INVERSE + COLUMNS + c, ry)
    store(rows, INVERSE + 2 * COLUMNS + c, rz)
    store(rows, SHEAR + c, ex / ez)
    store(rows, SHEAR + COLUMNS + c, ey / ez)
    store(rows, SHEAR + 2 * COLUMNS + c, splat(_ONE, 16) / ez)
    store(rows, BEST + c, select(good, best, splat(np.float32(-1.0), 16)))
    store(rows, U + c, zero)
    store(rows, V + c, zero)
    k0, k1, k2 = splat(np.int32(0), 16), splat(np.int32(1), 16), splat(np.int32(2), 16)
    store(ids, AXIS + c, select(first, k1, select(second, k2, k0)))
    store(ids, AXIS + COLUMNS + c, select(first, k2, select(second, k0, k1)))
    store(ids, AXIS + 2 * COLUMNS + c, select(first, k0, select(second, k1, k2)))
    store(ids, NEAR + c, _facing(rx, 0))
    store(ids, NEAR + COLUMNS + c, _facing(ry, 8))
    store(ids, NEAR + 2 * COLUMNS + c, _facing(rz, 16))
    store(ids, RAY_IDS + c, splat(np.int32(-1), 16))
    return bits(good)


# ---- Interleaved single rays: each advances by one block in turn, while the next blocks of the others are prefetched


#: Numbers of the state of a ray in flight, and of all of them.
_ROW = 4
STATE = RAYS_IN_FLIGHT * _ROW
_ZERO = np.float32(0.0)
#: Columns of a row of int64: column of the ray, next code, its key, top of the stack (negative: no ray is left).
_RAY, _CODE, _KEY, _TOP = 0, 1, 2, 3


@inner(forceinline=True)
def _splats(rows, at):
    """Return three rows of a column, the first at ``at``, as splats."""
    return splat(item(rows, at), 8), splat(item(rows, at + COLUMNS), 8), splat(item(rows, at + 2 * COLUMNS), 8)


@inner(forceinline=True)
def _scalars(rows, at):
    """Return three rows of a column, the first at ``at``."""
    return item(rows, at), item(rows, at + COLUMNS), item(rows, at + 2 * COLUMNS)


@inner(forceinline=True)
def _leaf(scene, code, key, c, rows, ids, scratch, any_hit):
    """Test the ray in column ``c`` with a leaf and store a nearer hit; return True if it is an any-hit ray that is finished."""
    tree, codes = scene[0], scene[1]
    base, mixed = block_offset(code), not triangles_alone(code)
    kx, ky, kz = _scalars(ids, AXIS + c)
    axes = (np.int64(kx), np.int64(ky), np.int64(kz))
    px, py, pz = (
        item(rows, ORIGIN + axes[0] * COLUMNS + c), item(rows, ORIGIN + axes[1] * COLUMNS + c),
        item(rows, ORIGIN + axes[2] * COLUMNS + c),
    )  # fmt: skip
    sx, sy = splat(item(rows, SHEAR + c), 8), splat(item(rows, SHEAR + COLUMNS + c), 8)
    met = crossed_triangles(tree, base, axes[0], axes[1], axes[2], splat(px, 8), splat(py, 8), splat(pz, 8), sx, sy)
    if bits(met[0]) == 0 and not mixed:
        return False
    best, previous = item(rows, BEST + c), item(ids, RAY_IDS + c)
    floor = as_float(key & -8) * FLOOR
    o, d, shear = _scalars(rows, ORIGIN + c), _scalars(rows, DIRECTION + c), _scalars(rows, SHEAR + c)
    if any_hit:
        q = (
            occluding_triangle(scene, base, met, shear[2], o, d, floor, best, previous, np.int32(0))
            if bits(met[0]) != 0
            else previous
        )
        if mixed and q < 0:
            _, q, _, _ = intersect_others(scene, code, base, o, d, axes, shear, floor, best, q, scratch, any_hit)
        put(ids, RAY_IDS + c, q)
        return q >= 0
    best, q, lane = nearest_triangle(
        tree, codes, base, met, shear[2], o, d, floor, best, previous, np.int32(0), scratch
    )
    if lane >= 0:
        put(rows, U + c, item(scratch, 8 + lane))
        put(rows, V + c, item(scratch, 16 + lane))
    if mixed:
        before = q
        best, q, a, b = intersect_others(scene, code, base, o, d, axes, shear, floor, best, q, scratch, any_hit)
        if q != before:
            put(rows, U + c, a)
            put(rows, V + c, b)
    if q != previous:
        put(rows, BEST + c, best)
        put(ids, RAY_IDS + c, q)
    return False


@inner(forceinline=True)
def trace_interleaved(count, scene, stack_length, rows, ids, work, any_hit):
    """Find the nearest hits of the rays in the first ``count`` columns, or any hits.

    Args:
        count: number of columns.
        scene: the tree as float32 and as int32, tables of other primitives, first ids of their kinds.
        stack_length: stack size of a ray.
        rows: rows of float32, see the constants above.
        ids: rows of int32, likewise.
        work: memory: keys and parents of the stacks (``RAYS_IN_FLIGHT * stack_length`` int32), ``STATE`` int64, ``SCRATCH``
            float32.
        any_hit: True: stop at the first opaque hit.
    """
    tree, codes = scene[0], scene[1]
    keys, parents, slots, scratch = work
    at, live = np.int64(0), np.int64(0)
    for r in range(RAYS_IN_FLIGHT):
        while at < count and not item(rows, BEST + at) > _ZERO:
            at += 1
        if at < count:
            put(slots, r * _ROW + _RAY, at)
            put(slots, r * _ROW + _CODE, 0)
            put(slots, r * _ROW + _TOP, 0)
            at += 1
            live += 1
    flying = live
    while live > 0:
        for r in range(flying):
            s, bottom = r * _ROW, r * stack_length
            top = bottom + item(slots, s + _TOP)
            if top < bottom:
                continue
            c, code = item(slots, s + _RAY), item(slots, s + _CODE)
            ended = False
            key = np.int32(0)
            if code >= 0:
                base = block_offset(code)
                nx, ny, nz = _scalars(ids, NEAR + c)
                ox, oy, oz = _splats(rows, ORIGIN + c)
                ix, iy, iz = _splats(rows, INVERSE + c)
                a, met = boxes(
                    tree, base, np.int64(nx), np.int64(ny), np.int64(nz), ox, oy, oz, ix, iy, iz,
                    splat(item(rows, BEST + c), 8),
                )  # fmt: skip
                top = push(keys, parents, top, base, a, met)
            else:
                ended = _leaf(scene, code, item(slots, s + _KEY), c, rows, ids, scratch, any_hit)
            if not ended:
                top, code, key = pop(codes, keys, parents, top, bottom, item(rows, BEST + c) * SLACK)
                ended = top < bottom
            if ended:
                while at < count and not item(rows, BEST + at) > _ZERO:
                    at += 1
                if at == count:
                    put(slots, s + _TOP, -1)
                    live -= 1
                    continue
                put(slots, s + _RAY, at)
                at += 1
                top, code = bottom, np.int64(0)
            put(slots, s + _TOP, top - bottom)
            put(slots, s + _CODE, code)
            put(slots, s + _KEY, np.int64(key))
            prefetch_block(tree, code)


# ---- Packets of sixteen rays: interval arithmetic culls a node's boxes, the remaining ones are tested with every ray
#
# After Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001), and the interval
# tests of Boulos, Wald and Shirley, "Geometric and Arithmetic Culling Methods for Entire Ray Packets" (2006).


#: Rays of a packet.
RAYS = 16
#: Float32 of scratch memory that a packet needs: origin, direction, floor, best distance, u and v of its rays.
SPARE = 10 * RAYS
#: Fewest active rays of a packet; fewer are traced one by one.
FEWEST = 4
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)


@inner(forceinline=True)
def is_coherent(c, good, rows):
    """Return True if the rays in columns ``c`` to ``c + 15`` form a packet: enough are in the mask ``good``, all of one octant.

    Also returns, for x, y and z, True if directions are positive, by the sign bit: -0 is negative.
    """
    none = splat(np.int32(0), 16)
    ux = bits(as_int(load(rows, DIRECTION + c, 16)) >= none) & good
    uy = bits(as_int(load(rows, DIRECTION + COLUMNS + c, 16)) >= none) & good
    uz = bits(as_int(load(rows, DIRECTION + 2 * COLUMNS + c, 16)) >= none) & good
    alike = (ux == 0 or ux == good) and (uy == 0 or uy == good) and (uz == 0 or uz == good)
    return alike and popcount(good) >= FEWEST, ux != 0, uy != 0, uz != 0


@inner(forceinline=True)
def _filled(rows, c, first, whole):
    """Load three rows of columns ``c`` to ``c + 15``, with column ``first`` in place of inactive rays."""
    return (
        select(whole, load(rows, c, 16), splat(item(rows, first), 16)),
        select(whole, load(rows, c + COLUMNS, 16), splat(item(rows, first + COLUMNS), 16)),
        select(whole, load(rows, c + 2 * COLUMNS, 16), splat(item(rows, first + 2 * COLUMNS), 16)),
    )


@inner(forceinline=True)
def _interval(o, inverse, up):
    """Return the intervals of 16 rays on one axis: origins for near and far planes, least and greatest reciprocal."""
    low, high = lowest(o), highest(o)
    near, far = (high, low) if up else (low, high)
    return splat(near, 8), splat(far, 8), splat(lowest(inverse), 8), splat(highest(inverse), 8)


@inner(forceinline=True)
def _met(tree, base, nx, ny, nz, x, y, z, limit):
    """Return lower bounds of all rays' entries into eight boxes, and the mask of boxes that a ray may hit before ``limit``."""
    ax, bx = load(tree, base + nx, 8) - x[0], load(tree, base + (24 - nx), 8) - x[1]
    ay, by = load(tree, base + ny, 8) - y[0], load(tree, base + (40 - ny), 8) - y[1]
    az, bz = load(tree, base + nz, 8) - z[0], load(tree, base + (56 - nz), 8) - z[1]
    a = maximum(
        maximum(minimum(ax * x[2], ax * x[3]), minimum(ay * y[2], ay * y[3])),
        maximum(minimum(az * z[2], az * z[3]), splat(_ZERO, 8)),
    )
    b = minimum(
        minimum(maximum(bx * x[2], bx * x[3]), maximum(by * y[2], by * y[3])),
        minimum(maximum(bz * z[2], bz * z[3]), splat(limit, 8)),
    )
    return a, a <= b * splat(SLACK, 8)


@inner(forceinline=True)
def _box(tree, at, nx, ny, nz, o, inverse, best):
    """Return every ray's entry into the box that begins at ``at``, and the mask of rays that hit it before ``best``."""
    ax = (splat(item(tree, at + nx), 16) - o[0]) * inverse[0]
    bx = (splat(item(tree, at + (24 - nx)), 16) - o[0]) * inverse[0]
    ay = (splat(item(tree, at + ny), 16) - o[1]) * inverse[1]
    by = (splat(item(tree, at + (40 - ny)), 16) - o[1]) * inverse[1]
    az = (splat(item(tree, at + nz), 16) - o[2]) * inverse[2]
    bz = (splat(item(tree, at + (56 - nz)), 16) - o[2]) * inverse[2]
    a = maximum(maximum(ax, ay), maximum(az, splat(_ZERO, 16)))
    return a, a <= minimum(minimum(bx, by), minimum(bz, best)) * splat(SLACK, 16)


@inner(forceinline=True)
def _corner(tree, at, m, p, s):
    """Return a corner in the sheared space of every ray; ``m`` has the masks of rays whose longest axis is x, and y."""
    x = splat(item(tree, at), 16) - p[0]
    y = splat(item(tree, at + 8), 16) - p[1]
    z = splat(item(tree, at + 16), 16) - p[2]
    depth = select(m[0], x, select(m[1], y, z))
    return (
        select(m[0], y, select(m[1], z, x)) - s[0] * depth,
        select(m[0], z, select(m[1], x, y)) - s[1] * depth,
        depth,
    )


@inner(forceinline=True)
def _triangle(tree, at, axes, s, o, d, floor):
    """Intersect 16 rays with the triangle whose first number is at ``at``: mask, ``t``, two edge functions, determinant.

    ``axes`` are the masks ``m`` of :func:`_corner`, ``s`` the shear; hits are clamped to at least ``floor``.
    """
    zero = splat(_ZERO, 16)
    ax, ay, za = _corner(tree, at, axes, o, s)
    bx, by, zb = _corner(tree, at + 24, axes, o, s)
    cx, cy, zc = _corner(tree, at + 48, axes, o, s)
    e, f, g = cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax
    low, high = minimum(minimum(e, f), g), maximum(maximum(e, f), g)
    det = e + f + g
    m = ((low >= zero) | (high <= zero)) & (det != zero)
    t = zero
    if bits(m) != 0:
        n0, n1 = splat(item(tree, at + PLANES), 16), splat(item(tree, at + PLANES + 8), 16)
        n2, c = splat(item(tree, at + PLANES + 16), 16), splat(item(tree, at + PLANES + 24), 16)
        plane = -(n0 * o[0] + n1 * o[1] + n2 * o[2] + c) / (n0 * d[0] + n1 * d[1] + n2 * d[2])
        za, zb, zc = za * s[2], zb * s[2], zc * s[2]
        t = minimum(maximum(plane, minimum(minimum(za, zb), zc)), maximum(maximum(za, zb), zc))
        m = m & (plane == plane) & (t > zero)
        t = maximum(t, floor)
    return m, t, f, g, det


@inner(forceinline=True)
def _rectangle(tree, at, axes, s, o, d):
    """Intersect 16 rays with one rectangle: mask, ``t``, u, v; see :func:`kernel_sources.tree_leaf.intersect_others`."""
    n0, n1 = splat(item(tree, at + RULED), 16), splat(item(tree, at + RULED + 8), 16)
    n2, n3 = splat(item(tree, at + RULED + 16), 16), splat(item(tree, at + RULED + 24), 16)
    plane = -(n0 * o[0] + n1 * o[1] + n2 * o[2] + n3) / (n0 * d[0] + n1 * d[1] + n2 * d[2])
    ax, ay, az = _corner(tree, at, axes, o, s)
    bx, by, bz = _corner(tree, at + 24, axes, o, s)
    cx, cy, cz = _corner(tree, at + 48, axes, o, s)
    qx, qy, qz = _corner(tree, at + FOURTH, axes, o, s)
    a, b, c, q = (ax, ay, az * s[2]), (bx, by, bz * s[2]), (cx, cy, cz * s[2]), (qx, qy, qz * s[2])
    return rectangle_hits(plane, a, b, c, q, splat(_ZERO, 16))


@inner(forceinline=True)
def _rest(scene, code, base, memory, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Intersect the rays of a mask, one by one, with a leaf's primitives that are neither triangles nor rectangles.

    ``memory`` is scratch memory for the values of the lanes.
    """
    spare, ids, scratch = memory
    for k in range(3):
        store(spare, 16 * k, o[k])
        store(spare, 48 + 16 * k, d[k])
    store(spare, 96, floor)
    store(spare, 112, best)
    store(spare, 128, u)
    store(spare, 144, v)
    store(ids, 0, prim)
    left = bits(lanes & (best > splat(_ZERO, 16)))
    while left != 0:
        j = trailing_zeros(left)
        left &= left - 1
        previous = item(ids, j)
        near, q, a, b = intersect_others(
            scene, code | 2, base,
            (item(spare, j), item(spare, 16 + j), item(spare, 32 + j)),
            (item(spare, 48 + j), item(spare, 64 + j), item(spare, 80 + j)),
            (0, 1, 2), (_ZERO, _ZERO, _ZERO), item(spare, 96 + j), item(spare, 112 + j), previous, scratch, any_hit,
        )  # fmt: skip
        if any_hit:
            put(ids, j, q)
            if q >= 0:
                put(spare, 112 + j, np.float32(-1.0))
        elif q != previous:
            put(ids, j, q)
            put(spare, 112 + j, near)
            put(spare, 128 + j, a)
            put(spare, 144 + j, b)
    return load(spare, 112, 16), load(ids, 0, 16), load(spare, 128, 16), load(spare, 144, 16)


@inner(forceinline=True)
def _packet_leaf(scene, code, memory, axes, s, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Update the hits of a packet's rays in the mask by a leaf; any-hit rays with an opaque hit get ``best`` -1."""
    tree, codes = scene[0], scene[1]
    base = block_offset(code)
    ruled = code & 2 == 0
    for k in range(8):
        q = item(codes, base + IDS + k)
        if q >= 0:
            m, t, f, g, det = _triangle(tree, base + k, axes, s, o, d, floor)
            a, b = f / det, g / det
        elif ruled and q < -1:
            q = np.int32(-2 - q)
            m, t, a, b = _rectangle(tree, base + RECTANGLES + k, axes, s, o, d)
            t = maximum(t, floor)
        else:
            continue
        id_ = splat(q, 16)
        m = m & lanes
        if any_hit:
            m = m & (t < best)
            q = blocking(scene, q)
            best, prim = select(m, splat(np.float32(-1.0), 16) if q >= 0 else best, best), select(m, splat(q, 16), prim)
        else:
            m = m & ((t < best) | ((t == best) & (id_ < prim)))
            best, prim = select(m, t, best), select(m, id_, prim)
            u, v = select(m, a, u), select(m, b, v)
    if code & 1 == 0:
        best, prim, u, v = _rest(scene, code, base, memory, o, d, floor, lanes, best, prim, u, v, any_hit)
    return best, prim, u, v


@inner(forceinline=True)
def store_hits(i, out, best, prim, u, v, any_hit):
    """Write the hits of 16 rays; of any-hit rays 1 if blocked, 2 if light may pass all that they hit, else 0."""
    missed = prim < splat(np.int32(0), 16)
    if any_hit:
        open_ = select(prim == splat(MAY_PASS, 16), splat(np.int32(2), 16), splat(np.int32(0), 16))
        store(out[1], i, select(missed, open_, splat(np.int32(1), 16)))
    else:
        store(out[0], i, select(missed, splat(_INF, 16), best))
        store(out[1], i, prim)
        store(out[2], i, u)
        store(out[3], i, v)


@inner(forceinline=True)
def trace_packet(i, c, good, ux, uy, uz, rows, axis, scene, stack, memory, out, any_hit):
    """Trace rays ``i`` to ``i + 15``, in columns ``c`` to ``c + 15``, as a packet; :func:`is_coherent` must hold for them."""
    tree, codes = scene[0], scene[1]
    keys, parents = stack
    first, whole = c + trailing_zeros(good), mask(good, 16)
    p, r = _filled(rows, ORIGIN + c, ORIGIN + first, whole), _filled(rows, DIRECTION + c, DIRECTION + first, whole)
    inverse = _filled(rows, INVERSE + c, INVERSE + first, whole)
    shear = _filled(rows, SHEAR + c, SHEAR + first, whole)
    longest = load(axis, AXIS + 2 * COLUMNS + c, 16)
    axes = (longest == splat(np.int32(0), 16), longest == splat(np.int32(1), 16))
    nx, ny, nz = 0 if ux else 24, 8 if uy else 32, 16 if uz else 40
    x, y, z = _interval(p[0], inverse[0], ux), _interval(p[1], inverse[1], uy), _interval(p[2], inverse[2], uz)
    best = load(rows, BEST + c, 16)
    prim, u, v = splat(np.int32(-1), 16), splat(_ZERO, 16), splat(_ZERO, 16)
    entry, lanes = splat(_ZERO, 16), best > splat(_ZERO, 16)
    limit = highest(best) * SLACK
    top, code = np.int64(0), np.int64(0)
    while top >= 0:
        if code >= 0:
            base = block_offset(code)
            a, met = _met(tree, base, nx, ny, nz, x, y, z, limit)
            top = push(keys, parents, top, base, a, met)
        else:
            floor = as_float(as_int(entry) & splat(np.int32(-8), 16)) * splat(FLOOR, 16)
            best, prim, u, v = _packet_leaf(
                scene, code, memory, axes, shear, p, r, floor, lanes, best, prim, u, v, any_hit
            )
            limit = highest(best) * SLACK
        while True:
            top -= 1
            if top < 0:
                break
            key = item(keys, top)
            if as_float(key & np.int32(-8)) > limit:
                continue
            base, k = np.int64(item(parents, top)), np.int64(key & np.int32(7))
            entry, lanes = _box(tree, base + k, nx, ny, nz, p, inverse, best)
            if bits(lanes) != 0:
                code = np.int64(item(codes, base + CHILDREN + k))
                break
    store_hits(i, out, best, prim, u, v, any_hit)


# ---- Kernels: nearest and any hits of a range of rays, coherent ones as packets, the others as interleaved single rays


@inner(inline="always")
def _trace(first, last, rays, scene, stack_length, groups, columns, work, spare, out, any_hit):
    """Trace rays ``first <= i < last``; their number is a multiple of 16.

    ``columns`` are the rows of :func:`load_rays`, ``groups`` the first ray of each sixteen columns.
    """
    rows, ids = columns
    i, count = first, np.int64(0)
    while i < last:
        good = load_rays(i, rays, count, rows, ids)
        together, ux, uy, uz = is_coherent(count, good, rows)
        if together:
            trace_packet(i, count, good, ux, uy, uz, rows, ids, scene, (work[0], work[1]), spare, out, any_hit)
        else:
            put(groups, count >> 4, i)
            count += 16
        i += 16
        if count == COLUMNS or (i >= last and count > 0):
            trace_interleaved(count, scene, stack_length, rows, ids, work, any_hit)
            for k in range(count >> 4):
                best, u, v = load(rows, BEST + 16 * k, 16), load(rows, U + 16 * k, 16), load(rows, V + 16 * k, 16)
                store_hits(item(groups, k), out, best, load(ids, RAY_IDS + 16 * k, 16), u, v, any_hit)
            count = np.int64(0)


#: Offsets in the scratch memory, in bytes: int64 first, then numbers of 32 bits, then the stacks. The edge is the remainder of
#: fewer than 16 rays: ten rows of float32, and primitives.
_SLOTS = 0
_GROUPS = _SLOTS + 8 * STATE
_ROWS = _GROUPS + 8 * (COLUMNS >> 4)
_IDS = _ROWS + 4 * FLOATS_OF_RAYS
_SCRATCH = _IDS + 4 * INTS_OF_RAYS
_LANES = _SCRATCH + 4 * SCRATCH
_KEPT = _LANES + 4 * SPARE
_EDGE = _KEPT + 4 * RAYS
_EDGE_IDS = _EDGE + 4 * 10 * RAYS
_STACKS = _EDGE_IDS + 4 * RAYS
assert _STACKS == PACKET_MEMORY


@inner(inline="always")
def _search(first, last, memory, o, d, t_max, stride, words, non_opaque, surfaces, t, prim, u, v, any_hit):
    """Run :func:`_trace`; a remainder of fewer than 16 rays is padded in separate memory."""
    tree, kinds = load_pointer(words, 0, np.float32), part(words, 4, np.int64)
    tables = (
        load_pointer(words, 1, np.float32),
        load_pointer(words, 2, np.float32),
        load_pointer(words, 3, np.float64),
    )
    stack_length = item(kinds, 4)
    scene = (tree, part(tree, 0, np.int32), tables, kinds, non_opaque, surfaces)
    keys = part(memory, _STACKS, np.int32)
    parents, slots = part(keys, RAYS_IN_FLIGHT * stack_length, np.int32), part(memory, _SLOTS, np.int64)
    groups, scratch = part(memory, _GROUPS, np.int64), part(memory, _SCRATCH, np.float32)
    work = (keys, parents, slots, scratch)
    ray_rows = (part(memory, _ROWS, np.float32), part(memory, _IDS, np.int32))
    spare = (part(memory, _LANES, np.float32), part(memory, _KEPT, np.int32), scratch)
    given, found = (o, d, t_max, stride), (t, prim, u, v)
    # the remainder of fewer than 16 rays, padded with rays that hit nothing
    end = last - (last - first) % RAYS
    edge, number = part(memory, _EDGE, np.float32), part(memory, _EDGE_IDS, np.int32)
    for j in range(10 * RAYS):
        put(edge, j, _ZERO)
    for j in range(last - end):
        put(edge, 6 * RAYS + j, item(t_max, end + j))
        for k in range(3):
            put(edge, k * RAYS + j, item(o, k * stride + end + j))
            put(edge, (3 + k) * RAYS + j, item(d, k * stride + end + j))
    given_edge = (edge, part(edge, 3 * RAYS, np.float32), part(edge, 6 * RAYS, np.float32), np.int64(RAYS))
    edge_t, edge_u, edge_v = 7 * RAYS, 8 * RAYS, 9 * RAYS
    found_edge = (
        part(edge, edge_t, np.float32), number, part(edge, edge_u, np.float32), part(edge, edge_v, np.float32),
    )  # fmt: skip
    for k in range(2):  # a single call, which is inlined and compiled once
        rays, out = (given, found) if k == 0 else (given_edge, found_edge)
        start, stop = (first, end) if k == 0 else (0, RAYS if end < last else 0)
        _trace(start, stop, rays, scene, stack_length, groups, ray_rows, work, spare, out, any_hit)
    for j in range(last - end):
        put(prim, end + j, item(number, j))
        if not any_hit:
            put(t, end + j, item(edge, edge_t + j))
            put(u, end + j, item(edge, edge_u + j))
            put(v, end + j, item(edge, edge_v + j))


@kernel("tree_nearest", INT, INT, BYTES, FLOATS, FLOATS, FLOATS, INT, LONGS, FLOATS, INTS, FLOATS, FLOATS)
def nearest(first, last, memory, o, d, t_max, stride, words, t, prim, u, v):
    """Find the nearest hits of rays ``first <= i < last``.

    Args:
        first: first ray.
        last: ray after the last one.
        memory: scratch memory of :func:`torchpt.search.tree_layout.packet_memory`.
        o: origins ``(3, stride)``.
        d: directions ``(3, stride)``.
        t_max: ends of the rays.
        stride: length of a row of ``o`` and ``d``.
        words: the scene, see :func:`torchpt.search.tree.scene_words`.
        t: filled; inf for a miss.
        prim: filled; -1 for a miss.
        u: filled.
        v: filled.
    """
    none = part(words, 0, np.uint8)
    _search(first, last, memory, o, d, t_max, stride, words, none, np.int64(0), t, prim, u, v, False)


@kernel("tree_occluded", INT, INT, BYTES, FLOATS, FLOATS, FLOATS, INT, LONGS, BYTES, INT, INTS)
def occluded(first, last, memory, o, d, t_max, stride, words, non_opaque, surfaces, out):
    """Write 1 to ``out`` for rays ``first <= i < last`` that hit an opaque primitive, else 0.

    ``non_opaque`` holds a uint8 for each of so many ``surfaces``, nonzero if light may pass: rays that hit only such primitives
    get 2. With 0 surfaces all primitives are opaque. The other arguments are those of :func:`nearest`.
    """
    _search(
        first, last, memory, o, d, t_max, stride, words, non_opaque, surfaces, t_max, out, t_max, t_max, True
    )  # fmt: skip
