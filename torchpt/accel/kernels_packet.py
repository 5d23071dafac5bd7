"""Sixteen rays at a time (numba): intervals of the packet cull a node's boxes, each box left is tested by every ray.

After Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001), and the interval
tests of Boulos, Wald and Shirley, "Geometric and Arithmetic Culling Methods for Entire Ray Packets" (2006).
"""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import CHILDREN, FLOOR, IDS, PLANES, SLACK, VEILED, blocking, place, push
from torchpt.accel.kernels_others import FOURTH, RECTANGLES, RULED, others
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
_ZERO, _ONE, _INF = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
_LEAST, _TINY = np.float32(1e-20), np.float32(1e-37)  # as in kernels_leaf.setup


@part(forceinline=True)
def coherent(rays, i):
    """Whether rays ``i`` to ``i + 15`` go as a packet: those that can hit are many, of one octant and one longest axis.

    Returns also the mask of those that can hit, which axis that is and whether directions rise along x, y and z. Signs are
    those of the sign bit, as -0 counts as falling.
    """
    o, d, t_max, n = rays
    ox, oy, oz = load(o, i, 16), load(o, n + i, 16), load(o, 2 * n + i, 16)
    dx, dy, dz = load(d, i, 16), load(d, n + i, 16), load(d, 2 * n + i, 16)
    zero, none = splat(_ZERO, 16), splat(np.int32(0), 16)
    sum_ = ox * zero + oy * zero + oz * zero + dx * zero + dy * zero + dz * zero
    good = bits((load(t_max, i, 16) > zero) & (sum_ == zero))
    ax, ay, az = absolute(dx), absolute(dy), absolute(dz)
    x = bits((ax >= ay) & (ax >= az)) & good
    y = bits(ay >= az) & ~x & good
    ux, uy, uz = bits(as_int(dx) >= none) & good, bits(as_int(dy) >= none) & good, bits(as_int(dz) >= none) & good
    alike = (x == 0 or x == good) and (y == 0 or y == good) and (ux == 0 or ux == good)
    alike = alike and (uy == 0 or uy == good) and (uz == 0 or uz == good) and population(good) >= FEWEST
    axis = 0 if x != 0 else (1 if y != 0 else 2)
    return alike, good, axis, ux != 0, uy != 0, uz != 0


@part(forceinline=True)
def _inverse(d, least):
    """Reciprocals that are never infinite."""
    sign = as_int(d) & splat(np.int32(-(2**31)), 16)
    return splat(_ONE, 16) / select(absolute(d) >= least, d, as_float(as_int(least) | sign))


@part(forceinline=True)
def _filled(a, i, first, whole):
    """16 numbers from place ``i`` on, the one at ``first`` where a ray is none that can hit."""
    return select(whole, load(a, i, 16), splat(item(a, first), 16))


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
def _corner(tree, at, x, y, z, p, s):
    """One corner of a triangle in the sheared place of every ray; see kernels_blocks.crossed."""
    depth = splat(item(tree, at + z), 16) - p[2]
    return (
        (splat(item(tree, at + x), 16) - p[0]) - s[0] * depth,
        (splat(item(tree, at + y), 16) - p[1]) - s[1] * depth,
        depth,
    )


@part(forceinline=True)
def _triangle(tree, at, axes, p, s, o, d, floor):
    """16 rays against one triangle, whose first number lies at ``at``: mask, ``t``, and what ``u`` and ``v`` come from."""
    x, y, z = axes[0] * 8, axes[1] * 8, axes[2] * 8
    zero = splat(_ZERO, 16)
    ax, ay, za = _corner(tree, at, x, y, z, p, s)
    bx, by, zb = _corner(tree, at + 24, x, y, z, p, s)
    cx, cy, zc = _corner(tree, at + 48, x, y, z, p, s)
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
        m = m & (plane > zero) & (plane < splat(_INF, 16)) & (t > zero)
        t = maximum(t, floor)
    return m, t, f, g, det


@part(forceinline=True)
def _rectangle(tree, at, axes, p, s, o, d):
    """16 rays against one rectangle: mask, ``t``, u and v; the operations of :func:`torchpt.accel.kernels_others.others`."""
    x, y, z = axes[0] * 8, axes[1] * 8, axes[2] * 8
    zero = splat(_ZERO, 16)
    n0, n1 = splat(item(tree, at + RULED), 16), splat(item(tree, at + RULED + 8), 16)
    n2, n3 = splat(item(tree, at + RULED + 16), 16), splat(item(tree, at + RULED + 24), 16)
    plane = -(n0 * o[0] + n1 * o[1] + n2 * o[2] + n3) / (n0 * d[0] + n1 * d[1] + n2 * d[2])
    ax, ay, az = _corner(tree, at, x, y, z, p, s)
    bx, by, bz = _corner(tree, at + 24, x, y, z, p, s)
    cx, cy, cz = _corner(tree, at + 48, x, y, z, p, s)
    qx, qy, qz = _corner(tree, at + FOURTH, x, y, z, p, s)
    az, bz, cz, qz = az * s[2], bz * s[2], cz * s[2], qz * s[2]
    f, g = ax * cy - ay * cx, bx * ay - by * ax
    h, k = qx * by - qy * bx, cx * qy - cy * qx
    low, high = minimum(minimum(f, g), minimum(h, k)), maximum(maximum(f, g), maximum(h, k))
    m = ((low >= zero) | (high <= zero)) & ((f + h) * (g + k) != zero) & (plane > zero) & (plane < splat(_INF, 16))
    near, far = minimum(minimum(minimum(az, bz), cz), qz), maximum(maximum(maximum(az, bz), cz), qz)
    t = minimum(maximum(plane, near), far)
    return m & (t > zero), t, f / (f + h), g / (g + k)


@part(forceinline=True)
def _rest(scene, code, base, rows, o, d, axes, shear, floor, lanes, best, prim, u, v, any_hit):
    """Every ray of the mask, one by one, against a leaf's primitives that are neither triangles nor rectangles.

    ``rows`` is memory for what lanes hold.
    """
    spare, ids, scratch = rows
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
            axes, (_ZERO, _ZERO, _ZERO), item(spare, 96 + j), item(spare, 112 + j), had, scratch, any_hit,
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
def _leaf(scene, code, rows, axes, p, s, o, d, floor, lanes, best, prim, u, v, any_hit):
    """Takes a leaf into the hits of the packet's rays that are in the mask; a ray that any hit settles gets ``best`` -1."""
    tree, codes = scene[0], scene[1]
    base = place(code)
    ruled = code & 2 == 0
    for k in range(8):
        q = item(codes, base + IDS + k)
        if q >= 0:
            m, t, f, g, det = _triangle(tree, base + k, axes, p, s, o, d, floor)
            a, b = f / det, g / det
        elif ruled and q < -1:
            q = np.int32(-2 - q)
            m, t, a, b = _rectangle(tree, base + RECTANGLES + k, axes, p, s, o, d)
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
        best, prim, u, v = _rest(scene, code, base, rows, o, d, axes, s, floor, lanes, best, prim, u, v, any_hit)
    return best, prim, u, v


@part(forceinline=True)
def deliver(i, out, best, prim, u, v, any_hit):
    """Writes the hits of 16 rays, or for each 1 where it is blocked, 2 where it met what may let light pass, else 0."""
    missed = prim < splat(np.int32(0), 16)
    if any_hit:
        open_ = select(prim == splat(VEILED, 16), splat(np.int32(2), 16), splat(np.int32(0), 16))
        store(out[1], i, select(missed, open_, splat(np.int32(1), 16)))
    else:
        store(out[0], i, select(missed, splat(_INF, 16), best))
        store(out[1], i, prim)
        store(out[2], i, u)
        store(out[3], i, v)


@part(forceinline=True)
def packet(i, good, axis, ux, uy, uz, rays, scene, stack, rows, out, any_hit):
    """The hits of rays ``i`` to ``i + 15``, which :func:`coherent` has found to go together."""
    tree, codes = scene[0], scene[1]
    keys, parents = stack
    o, d, t_max, n = rays
    first, whole = i + trailing_zeros(good), mask(good, 16)
    p = (_filled(o, i, first, whole), _filled(o, n + i, n + first, whole), _filled(o, 2 * n + i, 2 * n + first, whole))
    r = (_filled(d, i, first, whole), _filled(d, n + i, n + first, whole), _filled(d, 2 * n + i, 2 * n + first, whole))
    axes = (1, 2, 0) if axis == 0 else ((2, 0, 1) if axis == 1 else (0, 1, 2))
    turned = (p[1], p[2], p[0]) if axis == 0 else ((p[2], p[0], p[1]) if axis == 1 else p)
    ex, ey, ez = (r[1], r[2], r[0]) if axis == 0 else ((r[2], r[0], r[1]) if axis == 1 else r)
    shear = (ex / ez, ey / ez, splat(_ONE, 16) / ez)
    least = maximum(absolute(ez) * splat(_LEAST, 16), splat(_TINY, 16))
    inverse = (_inverse(r[0], least), _inverse(r[1], least), _inverse(r[2], least))
    nx, ny, nz = 0 if ux else 24, 8 if uy else 32, 16 if uz else 40
    x, y, z = _interval(p[0], inverse[0], ux), _interval(p[1], inverse[1], uy), _interval(p[2], inverse[2], uz)
    best = select(whole, load(t_max, i, 16), splat(np.float32(-1.0), 16))
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
            best, prim, u, v = _leaf(
                scene, code, rows, axes, turned, shear, p, r, floor, lanes, best, prim, u, v, any_hit
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
    deliver(i, out, best, prim, u, v, any_hit)
