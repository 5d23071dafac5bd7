"""Sixteen rays at a time (numba): intervals of the packet cull a node's boxes, each box left is tested by every ray.

After Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001), and the interval
tests of Boulos, Wald and Shirley, "Geometric and Arithmetic Culling Methods for Entire Ray Packets" (2006).
"""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import CHILDREN, FLOOR, IDS, MAY_PASS, PLANES, SLACK, blocking, place, push
from torchpt.accel.kernels_others import FOURTH, RECTANGLES, RULED, others
from torchpt.accel.kernels_rays import AXIS, BEST, COLUMNS, DIRECTION, INVERSE, ORIGIN, SHEAR
from torchpt.native.jit import part
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
    population,
    put,
    select,
    splat,
    store,
    trailing_zeros,
)

__all__ = ["RAYS", "SPARE", "coherent", "deliver", "packet"]

RAYS = 16
#: Numbers of memory that a packet needs.
SPARE = 10 * RAYS
#: Rays that repay a packet.
FEWEST = 4
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)


@part(forceinline=True)
def coherent(c, good, rows):
    """Whether the rays in columns ``c`` to ``c + 15`` go as a packet: those in the mask ``good`` are many, and of one octant.

    Returns also whether directions rise along x, y and z. Signs are those of the sign bit, as -0 counts as falling.
    """
    none = splat(np.int32(0), 16)
    ux = bits(as_int(load(rows, DIRECTION + c, 16)) >= none) & good
    uy = bits(as_int(load(rows, DIRECTION + COLUMNS + c, 16)) >= none) & good
    uz = bits(as_int(load(rows, DIRECTION + 2 * COLUMNS + c, 16)) >= none) & good
    alike = (ux == 0 or ux == good) and (uy == 0 or uy == good) and (uz == 0 or uz == good)
    return alike and population(good) >= FEWEST, ux != 0, uy != 0, uz != 0


@part(forceinline=True)
def _filled(rows, c, first, whole):
    """Three rows of columns ``c`` to ``c + 15``, those of column ``first`` where a ray is none that can hit."""
    return (
        select(whole, load(rows, c, 16), splat(item(rows, first), 16)),
        select(whole, load(rows, c + COLUMNS, 16), splat(item(rows, first + COLUMNS), 16)),
        select(whole, load(rows, c + 2 * COLUMNS, 16), splat(item(rows, first + 2 * COLUMNS), 16)),
    )


@part(forceinline=True)
def _interval(o, inverse, up):
    """What the culling test takes of 16 rays on one axis: origins for near and far planes, least and greatest reciprocal."""
    low, high = lowest(o), highest(o)
    near, far = (high, low) if up else (low, high)
    return splat(near, 8), splat(far, 8), splat(lowest(inverse), 8), splat(highest(inverse), 8)


@part(forceinline=True)
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


@part(forceinline=True)
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


@part(forceinline=True)
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


@part(forceinline=True)
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


@part(forceinline=True)
def _rectangle(tree, at, axes, s, o, d):
    """16 rays against one rectangle: mask, ``t``, u and v; the operations of :func:`torchpt.accel.kernels_others.others`."""
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


@part(forceinline=True)
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
        had = item(ids, j)
        near, q, a, b = others(
            scene, code | 2, base,
            (item(spare, j), item(spare, 16 + j), item(spare, 32 + j)),
            (item(spare, 48 + j), item(spare, 64 + j), item(spare, 80 + j)),
            (0, 1, 2), (_ZERO, _ZERO, _ZERO), item(spare, 96 + j), item(spare, 112 + j), had, scratch, any_hit,
        )  # fmt: skip
        if any_hit:
            put(ids, j, q)
            if q >= 0:
                put(spare, 112 + j, np.float32(-1.0))
        elif q != had:
            put(ids, j, q)
            put(spare, 112 + j, near)
            put(spare, 128 + j, a)
            put(spare, 144 + j, b)
    return load(spare, 112, 16), load(ids, 0, 16), load(spare, 128, 16), load(spare, 144, 16)


@part(forceinline=True)
def _leaf(scene, code, memory, axes, s, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Takes a leaf into the hits of the packet's rays that are in the mask; a ray that any hit settles gets ``best`` -1."""
    tree, codes = scene[0], scene[1]
    base = place(code)
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


@part(forceinline=True)
def deliver(i, out, best, prim, u, v, any_hit):
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


@part(forceinline=True)
def packet(i, c, good, ux, uy, uz, rows, axis, scene, stack, memory, out, any_hit):
    """The hits of rays ``i`` to ``i + 15`` in columns ``c`` to ``c + 15``, which :func:`coherent` has found to go together."""
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
            base = place(code)
            a, met = _met(tree, base, nx, ny, nz, x, y, z, limit)
            top = push(keys, parents, top, base, a, met)
        else:
            floor = as_float(as_int(entry) & splat(np.int32(-8), 16)) * splat(FLOOR, 16)
            best, prim, u, v = _leaf(scene, code, memory, axes, shear, p, r, floor, lanes, best, prim, u, v, any_hit)
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
    deliver(i, out, best, prim, u, v, any_hit)
