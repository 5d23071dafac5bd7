"""Packets of sixteen rays through the wide tree, and single rays where packets fall apart (numba)."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.native.jit import jit, jit_internal
from torchpt.native.simd import (
    absolute,
    as_float,
    as_int,
    bits,
    highest,
    item,
    load,
    lowest,
    mask,
    maximum,
    minimum,
    pointer,
    popcount,
    put,
    select,
    splat,
    store,
    trailing_zeros,
)
from torchpt.search.tree_layout import (
    CHILDREN,
    FLOOR,
    IDS,
    MAY_PASS,
    PLANES,
    SLACK,
    block_offset,
    blocking,
    boxes,
    crossed_triangles,
    prefetch_block,
    push,
    triangles_alone,
)
from torchpt.search.tree_leaf import FOURTH, RECTANGLES, RULED, intersect_others
from torchpt.search.tree_single import SCRATCH, nearest_triangle, occluding_triangle, pop

__all__ = [
    "AXIS",
    "BEST",
    "COLUMNS",
    "DIRECTION",
    "FLOATS",
    "INVERSE",
    "NEAR",
    "NUMBERS",
    "ORIGIN",
    "PIECES",
    "RAYS",
    "RAYS_IN_FLIGHT",
    "RAY_IDS",
    "SCRATCH",
    "SHEAR",
    "SPARE",
    "STATE",
    "U",
    "V",
    "blocked",
    "blocked_parallel",
    "is_coherent",
    "load_rays",
    "nearest",
    "nearest_parallel",
    "store_hits",
    "trace_interleaved",
    "trace_packet",
]


# ---- Rays as the search takes them (numba): sixteen at a time, in columns


#: Rays that are held at a time; the length of a row.
COLUMNS = 256
#: Rows of float32: origin, direction, reciprocal direction, shear, best distance (-1: nothing is to be found), u, v.
ORIGIN, DIRECTION, INVERSE, SHEAR, BEST, U, V = (k * COLUMNS for k in (0, 3, 6, 9, 12, 13, 14))
FLOATS = 15 * COLUMNS
#: Rows of int32: the axes with the direction's longest last, where the planes that face the ray begin, the primitive hit.
AXIS, NEAR, RAY_IDS = 0, 3 * COLUMNS, 6 * COLUMNS
NUMBERS = 7 * COLUMNS
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST, _TINY = np.float32(1e-20), np.float32(1e-37)  # as in kernels_leaf.setup


@jit_internal(forceinline=True)
def _inverse(d, least):
    """Reciprocals that are never infinite."""
    sign = as_int(d) & splat(np.int32(-(2**31)), 16)
    return splat(_ONE, 16) / select(absolute(d) >= least, d, as_float(as_int(least) | sign))


@jit_internal(forceinline=True)
def _facing(inverse, at):
    return select(inverse > splat(_ZERO, 16), splat(np.int32(at), 16), splat(np.int32(at + 24), 16))


@jit_internal(forceinline=True)
def load_rays(i, rays, c, rows, ids):
    """Fills columns ``c`` to ``c + 15`` with rays ``i`` to ``i + 15``; returns the mask of those that can hit anything."""
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


# ---- Several single rays in turn, one block each (numba): while the block of one is on its way from memory, others work


RAYS_IN_FLIGHT = 16  # rays in flight
_ROW = 4
STATE = RAYS_IN_FLIGHT * _ROW
_ZERO = np.float32(0.0)
#: Places in a row of int64: column of the ray, next code, its key, top of the stack (below 0: no ray is left).
_RAY, _CODE, _KEY, _TOP = 0, 1, 2, 3


@jit_internal(forceinline=True)
def _splats(rows, at):
    return splat(item(rows, at), 8), splat(item(rows, at + COLUMNS), 8), splat(item(rows, at + 2 * COLUMNS), 8)


@jit_internal(forceinline=True)
def _scalars(rows, at):
    return item(rows, at), item(rows, at + COLUMNS), item(rows, at + 2 * COLUMNS)


@jit_internal(forceinline=True)
def _leaf(scene, code, key, c, rows, ids, scratch, any_hit):
    """Tests a leaf and writes down what is nearer; returns whether an any-hit ray is settled."""
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


@jit_internal(forceinline=True)
def trace_interleaved(count, scene, stack_length, rows, ids, work, any_hit):
    """The nearest hits of the rays in the first ``count`` columns, or any hits.

    Args:
        count: how many columns.
        scene: the tree as float32 and as int32, tables of other primitives, where their kinds begin.
        stack_length: entries of a ray's stack.
        rows: rays, see :mod:`torchpt.search.tree_packet`.
        ids: likewise.
        work: memory: keys and parents of the stacks (``RAYS_IN_FLIGHT * stack_length`` int32 each), ``STATE`` int64, ``SCRATCH`` float32.
        any_hit: whether any hit will do.
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


# ---- Sixteen rays at a time (numba): intervals of the packet cull a node's boxes, each box left is tested by every ray
#
# After Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001), and the interval
# tests of Boulos, Wald and Shirley, "Geometric and Arithmetic Culling Methods for Entire Ray Packets" (2006).


RAYS = 16
#: Numbers of memory that a packet needs.
SPARE = 10 * RAYS
#: Rays that repay a packet.
FEWEST = 4
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)


@jit_internal(forceinline=True)
def is_coherent(c, good, rows):
    """Whether the rays in columns ``c`` to ``c + 15`` go as a packet: those in the mask ``good`` are many, and of one octant.

    Returns also whether directions rise along x, y and z. Signs are those of the sign bit, as -0 counts as falling.
    """
    none = splat(np.int32(0), 16)
    ux = bits(as_int(load(rows, DIRECTION + c, 16)) >= none) & good
    uy = bits(as_int(load(rows, DIRECTION + COLUMNS + c, 16)) >= none) & good
    uz = bits(as_int(load(rows, DIRECTION + 2 * COLUMNS + c, 16)) >= none) & good
    alike = (ux == 0 or ux == good) and (uy == 0 or uy == good) and (uz == 0 or uz == good)
    return alike and popcount(good) >= FEWEST, ux != 0, uy != 0, uz != 0


@jit_internal(forceinline=True)
def _filled(rows, c, first, whole):
    """Three rows of columns ``c`` to ``c + 15``, those of column ``first`` where a ray is none that can hit."""
    return (
        select(whole, load(rows, c, 16), splat(item(rows, first), 16)),
        select(whole, load(rows, c + COLUMNS, 16), splat(item(rows, first + COLUMNS), 16)),
        select(whole, load(rows, c + 2 * COLUMNS, 16), splat(item(rows, first + 2 * COLUMNS), 16)),
    )


@jit_internal(forceinline=True)
def _interval(o, inverse, up):
    """What the culling test takes of 16 rays on one axis: origins for near and far planes, least and greatest reciprocal."""
    low, high = lowest(o), highest(o)
    near, far = (high, low) if up else (low, high)
    return splat(near, 8), splat(far, 8), splat(lowest(inverse), 8), splat(highest(inverse), 8)


@jit_internal(forceinline=True)
def _met(tree, base, nx, ny, nz, x, y, z, limit):
    """Entries no later than those of any ray, and the mask of the boxes that some ray may meet before ``limit``."""
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


@jit_internal(forceinline=True)
def _box(tree, at, nx, ny, nz, o, inverse, best):
    """Every ray's entry into one box, whose first number lies at ``at``, and the mask of those that meet it."""
    ax = (splat(item(tree, at + nx), 16) - o[0]) * inverse[0]
    bx = (splat(item(tree, at + (24 - nx)), 16) - o[0]) * inverse[0]
    ay = (splat(item(tree, at + ny), 16) - o[1]) * inverse[1]
    by = (splat(item(tree, at + (40 - ny)), 16) - o[1]) * inverse[1]
    az = (splat(item(tree, at + nz), 16) - o[2]) * inverse[2]
    bz = (splat(item(tree, at + (56 - nz)), 16) - o[2]) * inverse[2]
    a = maximum(maximum(ax, ay), maximum(az, splat(_ZERO, 16)))
    return a, a <= minimum(minimum(bx, by), minimum(bz, best)) * splat(SLACK, 16)


@jit_internal(forceinline=True)
def _corner(tree, at, m, p, s):
    """A corner in the sheared place of every ray, see kernels_blocks.crossed; ``m`` says whose longest axis is x, whose y."""
    x = splat(item(tree, at), 16) - p[0]
    y = splat(item(tree, at + 8), 16) - p[1]
    z = splat(item(tree, at + 16), 16) - p[2]
    depth = select(m[0], x, select(m[1], y, z))
    return (
        select(m[0], y, select(m[1], z, x)) - s[0] * depth,
        select(m[0], z, select(m[1], x, y)) - s[1] * depth,
        depth,
    )


@jit_internal(forceinline=True)
def _triangle(tree, at, axes, s, o, d, floor):
    """16 rays against one triangle, whose first number lies at ``at``: mask, ``t``, and what ``u`` and ``v`` come from."""
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


@jit_internal(forceinline=True)
def _rectangle(tree, at, axes, s, o, d):
    """16 rays against one rectangle: mask, ``t``, u and v; the operations of :func:`torchpt.search.tree_leaf.intersect_others`."""
    zero = splat(_ZERO, 16)
    n0, n1 = splat(item(tree, at + RULED), 16), splat(item(tree, at + RULED + 8), 16)
    n2, n3 = splat(item(tree, at + RULED + 16), 16), splat(item(tree, at + RULED + 24), 16)
    plane = -(n0 * o[0] + n1 * o[1] + n2 * o[2] + n3) / (n0 * d[0] + n1 * d[1] + n2 * d[2])
    ax, ay, az = _corner(tree, at, axes, o, s)
    bx, by, bz = _corner(tree, at + 24, axes, o, s)
    cx, cy, cz = _corner(tree, at + 48, axes, o, s)
    qx, qy, qz = _corner(tree, at + FOURTH, axes, o, s)
    az, bz, cz, qz = az * s[2], bz * s[2], cz * s[2], qz * s[2]
    f, g = ax * cy - ay * cx, bx * ay - by * ax
    h, k = qx * by - qy * bx, cx * qy - cy * qx
    low, high = minimum(minimum(f, g), minimum(h, k)), maximum(maximum(f, g), maximum(h, k))
    det = minimum(absolute(f + h), absolute(g + k))  # a product would be the fourth power of a length
    m = ((low >= zero) | (high <= zero)) & (det != zero) & (plane == plane)
    near, far = minimum(minimum(minimum(az, bz), cz), qz), maximum(maximum(maximum(az, bz), cz), qz)
    t = minimum(maximum(plane, near), far)
    return m & (t > zero), t, f / (f + h), g / (g + k)


@jit_internal(forceinline=True)
def _rest(scene, code, base, memory, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Every ray of the mask, one by one, against a leaf's primitives that are neither triangles nor rectangles.

    ``memory`` is for what lanes hold.
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


@jit_internal(forceinline=True)
def _packet_leaf(scene, code, memory, axes, s, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Takes a leaf into the hits of the packet's rays that are in the mask; a ray that any hit settles gets ``best`` -1."""
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


@jit_internal(forceinline=True)
def store_hits(i, out, best, prim, u, v, any_hit):
    """Writes the hits of 16 rays, or for each 1 where it is blocked, 2 where it met what may let light pass, else 0."""
    missed = prim < splat(np.int32(0), 16)
    if any_hit:
        open_ = select(prim == splat(MAY_PASS, 16), splat(np.int32(2), 16), splat(np.int32(0), 16))
        store(out[1], i, select(missed, open_, splat(np.int32(1), 16)))
    else:
        store(out[0], i, select(missed, splat(_INF, 16), best))
        store(out[1], i, prim)
        store(out[2], i, u)
        store(out[3], i, v)


@jit_internal(forceinline=True)
def trace_packet(i, c, good, ux, uy, uz, rows, axis, scene, stack, memory, out, any_hit):
    """The hits of rays ``i`` to ``i + 15`` in columns ``c`` to ``c + 15``, which :func:`is_coherent` has found to go together."""
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


# ---- Closest and any hits of a range of rays (numba): packets where sixteen rays go together, the others in turn


#: Pieces of work a thread: rays of one place may take longer than those of another.
PIECES = 8


@jit_internal(inline="always")
def _trace(first, last, rays, scene, stack_length, groups, columns, work, spare, out, any_hit):
    """Rays ``first`` to ``last``, a multiple of 16."""
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


@jit_internal()
def _none():
    return np.empty(0, np.uint8)


@jit_internal(inline="always")
def _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, t, prim, u, v, any_hit):
    """:func:`_trace` with its memory; the rays beyond the last sixteen in memory of their own."""
    stack_length = kinds[4]
    keys, parents = np.empty(RAYS_IN_FLIGHT * stack_length, np.int32), np.empty(RAYS_IN_FLIGHT * stack_length, np.int32)
    slots, scratch, groups = np.empty(STATE, np.int64), np.empty(SCRATCH, np.float32), np.empty(COLUMNS >> 4, np.int64)
    columns, numbers = np.empty(FLOATS, np.float32), np.empty(NUMBERS, np.int32)
    lanes, kept = np.empty(SPARE, np.float32), np.empty(RAYS, np.int32)
    tables = (pointer(corner), pointer(rows), pointer(quadrics))
    scene = (pointer(tree), pointer(codes), tables, pointer(kinds), pointer(non_opaque), len(non_opaque))
    work = (pointer(keys), pointer(parents), pointer(slots), pointer(scratch))
    ray_rows = (pointer(columns), pointer(numbers))
    spare = (pointer(lanes), pointer(kept), pointer(scratch))
    given = (pointer(o), pointer(d), pointer(t_max), d.shape[1])
    found = (pointer(t), pointer(prim), pointer(u), pointer(v))
    # rays beyond the last sixteen, with others that can hit nothing
    end = last - (last - first) % RAYS
    edge, number = np.zeros(10 * RAYS, np.float32), np.zeros(RAYS, np.int32)
    for j in range(last - end):
        edge[6 * RAYS + j] = t_max[end + j]
        for k in range(3):
            edge[k * RAYS + j], edge[(3 + k) * RAYS + j] = o[k, end + j], d[k, end + j]
    given_edge = (pointer(edge), pointer(edge[3 * RAYS :]), pointer(edge[6 * RAYS :]), RAYS)
    found_edge = (pointer(edge[7 * RAYS :]), pointer(number), pointer(edge[8 * RAYS :]), pointer(edge[9 * RAYS :]))
    for k in range(2):  # one place of call: what is inlined is compiled once
        rays, out = (given, found) if k == 0 else (given_edge, found_edge)
        start, stop = (first, end) if k == 0 else (0, RAYS if end < last else 0)
        _trace(start, stop, rays, scene, stack_length, pointer(groups), ray_rows, work, spare, out, any_hit)
    for j in range(last - end):
        prim[end + j] = number[j]
        if not any_hit:
            t[end + j], u[end + j], v[end + j] = edge[7 * RAYS + j], edge[8 * RAYS + j], edge[9 * RAYS + j]
    # what pointers point to lives until here
    keys[0], parents[0], slots[0], scratch[0], groups[0] = 0, 0, 0, 0, 0
    columns[0], numbers[0], lanes[0], kept[0], edge[0], number[0] = 0, 0, 0, 0, 0, 0


@jit()
def nearest(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v):
    """The nearest hits of rays ``first <= i < last``.

    Args:
        first: ray.
        last: ray.
        o: origins ``(3, N)`` float32.
        d: directions ``(3, N)``.
        t_max: where each ray ends ``(N,)``.
        tree: blocks of nodes and leaves, see :mod:`torchpt.search.tree_layout`.
        codes: the same memory as int32.
        corner: ``(K, 12)`` corners of the primitives that are no triangles.
        rows: ``(K, 12)`` their affine rows.
        quadrics: ``(Q, 19)`` float64.
        kinds: ``(5,)`` int64: ids of the first rectangle, disk, sphere and quadric; room of a stack.
        t: ``(N,)`` float32, filled; inf for a miss.
        prim: ``(N,)`` int32, filled; -1 for a miss.
        u: ``(N,)`` float32, filled.
        v: ``(N,)`` float32, filled.
    """
    _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, _none(), t, prim, u, v, False)


@jit(parallel=True)
def nearest_parallel(chunks, items, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v):
    """:func:`nearest` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            nearest(a, b, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v)


@jit()
def blocked(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, out):
    """What stands in the way of rays ``first <= i < last``: 1 in ``out`` ``(N,)`` int32 for what blocks, 0 for nothing.

    Where ``non_opaque`` is not empty it holds a uint8 for each primitive, not 0 where light may pass: 2 in ``out`` is
    for rays that meet such primitives alone.
    """
    _search(
        first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, t_max, out, t_max, t_max, True
    )


@jit(parallel=True)
def blocked_parallel(chunks, items, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, out):
    """:func:`blocked` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            blocked(a, b, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, out)
