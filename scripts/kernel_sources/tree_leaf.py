"""Intersect one ray with the primitives of a leaf that are not triangles: rectangles, disks, spheres, quadrics.

For the names of values see :mod:`kernel_sources.tree_nodes`.
"""

from __future__ import annotations

import math

import numpy as np

from kernel_sources.jit import inner
from kernel_sources.simd import absolute, bits, item, load, maximum, minimum, splat, store, trailing_zeros
from kernel_sources.tree_nodes import blocking
from torchpt.search.tree_layout import FOURTH, IDS, RECTANGLES, RULED

__all__ = [
    "intersect_others",
    "intersect_primitive",
    "quadric_hit",
    "rectangle_hits",
    "setup_ray",
    "sphere_distance",
]


# ---- Spheres


@inner(forceinline=True)
def sphere_distance(ox, oy, oz, dx, dy, dz, cx, cy, cz, radius):
    """Return the nearest positive ``t`` at which ``o + t d`` hits the sphere, as float32; NaN for a miss.

    Haines et al., "Precision Improvements for Ray/Sphere Intersection", Ray Tracing Gems, ch. 7: the discriminant comes
    from the perpendicular from the centre to the ray, the roots from ``q = b + sign(b) sqrt(a disc)``. In float64, so
    that rays that start on the sphere, offset by a few float32 ulps, start on the right side of it.
    """
    fx, fy, fz = np.float64(ox) - cx, np.float64(oy) - cy, np.float64(oz) - cz
    ex, ey, ez = np.float64(dx), np.float64(dy), np.float64(dz)
    a = ex * ex + ey * ey + ez * ez
    b = -(fx * ex + fy * ey + fz * ez)
    s = b / a
    lx, ly, lz = fx + s * ex, fy + s * ey, fz + s * ez
    disc = radius * radius - (lx * lx + ly * ly + lz * lz)
    root = math.sqrt(a * disc)  # NaN for a miss: every comparison below is then false
    q = b + (root if b >= 0.0 else -root)
    near = (fx * fx + fy * fy + fz * fz - radius * radius) / q
    far = q / a
    low = near if near < far else far
    high = far if near < far else near
    return np.float32(low if low > 0.0 else high)


# ---- Rows of affine transforms


@inner(forceinline=True)
def _linear(table, at, x, y, z):
    """Return a vector times the three numbers of a table from ``at`` on."""
    return item(table, at) * x + item(table, at + 1) * y + item(table, at + 2) * z


@inner(forceinline=True)
def _affine(table, at, x, y, z):
    """Return a point times the three numbers of a table from ``at`` on, plus the fourth."""
    return _linear(table, at, x, y, z) + item(table, at + 3)


# ---- Quadrics, in their own space: the operations of ``leaf.quadric``, in the same order


_INFINITE = np.float64(np.inf)
_NAN32 = np.float32(np.nan)


@inner(forceinline=True)
def _sign(x):
    return math.copysign(1.0, x)


@inner(forceinline=True)
def _diamond(x, y):
    """Return the distance along the square ``|x| + |y| = 1`` from +x to a direction: in [-2, 2], monotonic in the angle."""
    s = abs(x) + abs(y)
    c = abs(x) / s if s > 0.0 else 1.0
    return (1.0 - c if x >= 0.0 else 1.0 + c) * _sign(y)


@inner()
def quadric_hit(table, k, ox, oy, oz, dx, dy, dz):
    """Return ``t, u, v`` as float32 of the nearest hit on quadric ``k`` of ``table (Q, 19)``; ``t`` is NaN for a miss.

    See :func:`torchpt.search.leaf.quadric` for the formulas and the definition of ``u, v``.
    """
    px, py, pz = np.float64(ox), np.float64(oy), np.float64(oz)
    rx, ry, rz = np.float64(dx), np.float64(dy), np.float64(dz)
    fx, fy, fz = (
        _affine(table, 19 * k + 0, px, py, pz),
        _affine(table, 19 * k + 4, px, py, pz),
        _affine(table, 19 * k + 8, px, py, pz),
    )
    ex, ey, ez = (
        _linear(table, 19 * k + 0, rx, ry, rz),
        _linear(table, 19 * k + 4, rx, ry, rz),
        _linear(table, 19 * k + 8, rx, ry, rz),
    )
    bend, level, shift = item(table, 19 * k + 12), item(table, 19 * k + 13), item(table, 19 * k + 14)
    low, high = item(table, 19 * k + 15), item(table, 19 * k + 16)
    around, half = item(table, 19 * k + 17), item(table, 19 * k + 18)
    wz = fz - shift
    a = ex * ex + ey * ey + bend * (ez * ez)
    b = -(fx * ex + fy * ey + bend * (wz * ez))
    c = fx * fx + fy * fy + bend * (wz * wz) - level
    cx, cy, cz = fy * ez - wz * ey, wz * ex - fx * ez, fx * ey - fy * ex
    disc = level * a - (bend * (cx * cx + cy * cy) + cz * cz)
    if half != 0.0:
        b -= half * ez
        c += 2.0 * half * wz
        disc += half * (half * (ez * ez) + 2.0 * (ey * cx - ex * cy))
    root = math.sqrt(disc)  # NaN for a miss: every comparison below is then false
    q = b + (root if b >= 0.0 else -root)
    t1, t2 = c / q, q / a
    z1, z2 = fz + t1 * ez, fz + t2 * ez
    ok1 = t1 > 0.0 and t1 < _INFINITE and z1 >= low and z1 <= high
    ok2 = t2 > 0.0 and t2 < _INFINITE and z2 >= low and z2 <= high
    if not (ok1 or ok2):
        return _NAN32, np.float32(0.0), np.float32(0.0)
    t = t1 if ok1 and not (ok2 and t2 < t1) else t2
    x, y, z = fx + t * ex, fy + t * ey, fz + t * ez
    if around == 0.0:
        return np.float32(t), np.float32(_diamond(x, y)), np.float32(z)
    size = abs(x) + abs(y) + abs(z)
    u, v = x / size, y / size
    if z < 0.0:
        u, v = (1.0 - abs(v)) * _sign(u), (1.0 - abs(u)) * _sign(v)
    return np.float32(t), np.float32(u), np.float32(v)


# ---- Any primitive but triangles (see :mod:`torchpt.search.tree_layout`): the operations of :mod:`torchpt.search.leaf`


_NAN = np.float32(np.nan)
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@inner(forceinline=True)
def setup_ray(dx, dy, dz):
    """Return the axes, that of the largest component last, the shear, and reciprocals of the direction, which are finite.

    They are the values of :class:`torchpt.search.leaf.Rays`, by the same operations.
    """
    x, y, z = abs(dx), abs(dy), abs(dz)
    kz = 0 if x >= y and x >= z else (1 if y >= z else 2)
    kx, ky = (1, 2) if kz == 0 else ((2, 0) if kz == 1 else (0, 1))
    px, py, pz = (dy, dz, dx) if kz == 0 else ((dz, dx, dy) if kz == 1 else (dx, dy, dz))
    least = max(abs(pz) * np.float32(1e-20), np.float32(1e-37))
    ix = _ONE / (dx if x >= least else np.float32(math.copysign(least, dx)))
    iy = _ONE / (dy if y >= least else np.float32(math.copysign(least, dy)))
    iz = _ONE / (dz if z >= least else np.float32(math.copysign(least, dz)))
    return kx, ky, kz, px / pz, py / pz, _ONE / pz, ix, iy, iz


@inner()
def intersect_primitive(prim, corner, rows, quadrics, n2, n3, n4, o, d):
    """Return ``t, u, v`` of ray ``o, d`` (tuples) at a disk, sphere or quadric; ``t`` is NaN for a miss.

    ``prim`` counts from the first rectangle; ``n2`` to ``n4`` are the numbers of the first disk, sphere and quadric. ``corner``
    is ``(K, 12)``; its first four numbers are centre and radius of a sphere.
    """
    if prim >= n3:
        if prim >= n4:
            return quadric_hit(quadrics, prim - n4, o[0], o[1], o[2], d[0], d[1], d[2])
        x, y, z = item(corner, 12 * prim), item(corner, 12 * prim + 1), item(corner, 12 * prim + 2)
        radius = np.float64(item(corner, 12 * prim + 3))
        t = sphere_distance(o[0], o[1], o[2], d[0], d[1], d[2], x, y, z, radius)
        return t, _ZERO, _ZERO
    away, along = _affine(rows, 12 * prim, o[0], o[1], o[2]), _linear(rows, 12 * prim, d[0], d[1], d[2])
    plane = -away / along
    if not (plane > _ZERO and plane < _INF):
        return _NAN, _ZERO, _ZERO
    x, y, z = o[0] + plane * d[0], o[1] + plane * d[1], o[2] + plane * d[2]
    u, v = _affine(rows, 12 * prim + 4, x, y, z), _affine(rows, 12 * prim + 8, x, y, z)
    return (plane if u * u + v * v <= _ONE else _NAN), u, v


# ---- A leaf: eight rectangles at once, other primitives one by one


@inner(forceinline=True)
def _corner(tree, at, axes, p, s):
    """Return a corner of eight rectangles in sheared space, as splats ``p`` and ``s`` of the ray's origin and shear define it.

    See :func:`kernel_sources.tree_nodes.crossed_triangles`.
    """
    z = load(tree, at + axes[2] * 8, 8) - p[2]
    x = (load(tree, at + axes[0] * 8, 8) - p[0]) - s[0] * z
    return x, (load(tree, at + axes[1] * 8, 8) - p[1]) - s[1] * z, z * s[2]


@inner(forceinline=True)
def rectangle_hits(plane, a, b, c, q, zero):
    """Return mask of hits, ``t``, u and v of rays at rectangles, by the operations of :func:`torchpt.search.leaf.distances`.

    ``plane`` are distances of the planes; then the corners in sheared space, with depths in units of ``t``; a splat of 0.
    """
    f, g = a[0] * c[1] - a[1] * c[0], b[0] * a[1] - b[1] * a[0]
    h, k = q[0] * b[1] - q[1] * b[0], c[0] * q[1] - c[1] * q[0]
    low, high = minimum(minimum(f, g), minimum(h, k)), maximum(maximum(f, g), maximum(h, k))
    det = minimum(absolute(f + h), absolute(g + k))  # a product would be the fourth power of a length
    met = ((low >= zero) | (high <= zero)) & (det != zero) & (plane == plane)
    near, far = minimum(minimum(minimum(a[2], b[2]), c[2]), q[2]), maximum(maximum(maximum(a[2], b[2]), c[2]), q[2])
    t = minimum(maximum(plane, near), far)
    return met & (t > zero), t, f / (f + h), g / (g + k)


@inner(forceinline=True)
def _rectangles(tree, at, axes, o, d, p, s):
    """Intersect eight rectangles, see :func:`rectangle_hits`.

    ``at`` is the offset of the rectangles in the tree; ``o``, ``d`` are tuples; ``p`` and ``s`` splats, see :func:`_corner`.
    """
    n0, n1 = load(tree, at + RULED, 8), load(tree, at + RULED + 8, 8)
    n2, n3 = load(tree, at + RULED + 16, 8), load(tree, at + RULED + 24, 8)
    away = n0 * splat(o[0], 8) + n1 * splat(o[1], 8) + n2 * splat(o[2], 8) + n3
    along = n0 * splat(d[0], 8) + n1 * splat(d[1], 8) + n2 * splat(d[2], 8)
    a, b = _corner(tree, at, axes, p, s), _corner(tree, at + 24, axes, p, s)
    c, q = _corner(tree, at + 48, axes, p, s), _corner(tree, at + FOURTH, axes, p, s)
    return rectangle_hits(-away / along, a, b, c, q, splat(_ZERO, 8))


@inner()
def intersect_others(scene, code, base, o, d, axes, shear, floor, best, prim, scratch, any_hit):
    """Update the nearest hit of one ray by a leaf's primitives that are not triangles.

    Args:
        scene: the tree as float32 and as int32; corners, affine rows and quadrics of all primitives but triangles; ids of the
            first rectangle, disk, sphere and quadric; the tables of :func:`kernel_sources.tree_nodes.blocking`.
        code: code of the leaf.
        base: offset of the leaf.
        o: origin.
        d: direction.
        axes: order of the axes.
        shear: see :func:`kernel_sources.tree_leaf.setup_ray`.
        floor: least distance of a hit here.
        best: distance of the nearest hit so far.
        prim: primitive of that hit, or -1; for any-hit rays see :func:`kernel_sources.tree_nodes.blocking`.
        scratch: 24 float32.
        any_hit: True: stop at the first opaque hit; of the results only ``prim`` is defined then.

    Returns:
        ``best, prim, u, v``; ``u`` and ``v`` are undefined if ``prim`` has not changed.
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
            if q < disk:  # triangles and unused entries give negative numbers
                continue
            t, a, b = intersect_primitive(
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
