"""One ray against one primitive that is no triangle (numba): the operations of :mod:`torchpt.accel.leaf`, none fused.

Triangles are met eight at a time, see :mod:`torchpt.accel.kernels_blocks`.
"""

from __future__ import annotations

import math

import numpy as np

from torchpt.accel.kernels_quadric import quadric_hit
from torchpt.accel.kernels_sphere import sphere_distance
from torchpt.native.jit import part
from torchpt.native.simd import item

__all__ = ["distance", "setup"]

_NAN = np.float32(np.nan)
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@part(forceinline=True)
def setup(dx, dy, dz):
    """Axes with the largest component last, the shear, and reciprocals that are never infinite."""
    x, y, z = abs(dx), abs(dy), abs(dz)
    kz = 0 if x >= y and x >= z else (1 if y >= z else 2)
    kx, ky = (1, 2) if kz == 0 else ((2, 0) if kz == 1 else (0, 1))
    px, py, pz = (dy, dz, dx) if kz == 0 else ((dz, dx, dy) if kz == 1 else (dx, dy, dz))
    least = max(abs(pz) * np.float32(1e-20), np.float32(1e-37))
    ix = _ONE / (dx if x >= least else np.float32(math.copysign(least, dx)))
    iy = _ONE / (dy if y >= least else np.float32(math.copysign(least, dy)))
    iz = _ONE / (dz if z >= least else np.float32(math.copysign(least, dz)))
    return kx, ky, kz, px / pz, py / pz, _ONE / pz, ix, iy, iz


@part(forceinline=True)
def _sheared(corner, prim, k, kx, ky, kz, px, py, pz, sx, sy, sz):
    x, y, z = (
        item(corner, 12 * prim + k + kx) - px,
        item(corner, 12 * prim + k + ky) - py,
        item(corner, 12 * prim + k + kz) - pz,
    )
    return x - sx * z, y - sy * z, z * sz


@part()
def distance(prim, corner, rows, quadrics, n2, n3, n4, o, d, kx, ky, kz, sx, sy, sz):
    """``t, u, v`` of ray ``o, d`` (tuples) at a primitive; ``t`` is NaN where it misses.

    Primitives are rectangles first; ``n2`` to ``n4`` are the numbers of the first disk, sphere and quadric. ``corner`` is
    ``(K, 12)``: p0, p1, p2 and the fourth corner; the axes and the shear come from :func:`setup`.
    """
    if prim >= n3:
        if prim >= n4:
            return quadric_hit(quadrics, prim - n4, o[0], o[1], o[2], d[0], d[1], d[2])
        x, y, z = item(corner, 12 * prim), item(corner, 12 * prim + 1), item(corner, 12 * prim + 2)
        radius = np.float64(item(corner, 12 * prim + 3))
        t = sphere_distance(o[0], o[1], o[2], d[0], d[1], d[2], x, y, z, radius)
        return t, _ZERO, _ZERO
    away = (
        item(rows, 12 * prim + 0) * o[0]
        + item(rows, 12 * prim + 1) * o[1]
        + item(rows, 12 * prim + 2) * o[2]
        + item(rows, 12 * prim + 3)
    )
    along = item(rows, 12 * prim + 0) * d[0] + item(rows, 12 * prim + 1) * d[1] + item(rows, 12 * prim + 2) * d[2]
    plane = -away / along
    if not (plane > _ZERO and plane < _INF):
        return _NAN, _ZERO, _ZERO
    if prim >= n2:
        x, y, z = o[0] + plane * d[0], o[1] + plane * d[1], o[2] + plane * d[2]
        u = (
            item(rows, 12 * prim + 4) * x
            + item(rows, 12 * prim + 5) * y
            + item(rows, 12 * prim + 6) * z
            + item(rows, 12 * prim + 7)
        )
        v = (
            item(rows, 12 * prim + 8) * x
            + item(rows, 12 * prim + 9) * y
            + item(rows, 12 * prim + 10) * z
            + item(rows, 12 * prim + 11)
        )
        return (plane if u * u + v * v <= _ONE else _NAN), u, v
    px, py, pz = o[kx], o[ky], o[kz]
    first = np.int64(0)
    ax, ay, az = _sheared(corner, prim, first, kx, ky, kz, px, py, pz, sx, sy, sz)
    bx, by, bz = _sheared(corner, prim, first + 3, kx, ky, kz, px, py, pz, sx, sy, sz)
    cx, cy, cz = _sheared(corner, prim, first + 6, kx, ky, kz, px, py, pz, sx, sy, sz)
    qx, qy, qz = _sheared(corner, prim, first + 9, kx, ky, kz, px, py, pz, sx, sy, sz)
    f, g = ax * cy - ay * cx, bx * ay - by * ax
    h, k = qx * by - qy * bx, cx * qy - cy * qx
    low, high = min(min(f, g), min(h, k)), max(max(f, g), max(h, k))
    det = min(abs(f + h), abs(g + k))  # a product would be the fourth power of a length
    if not ((low >= _ZERO or high <= _ZERO) and det != _ZERO):
        return _NAN, _ZERO, _ZERO
    near, far = min(min(min(az, bz), cz), qz), max(max(max(az, bz), cz), qz)
    return min(max(plane, near), far), f / (f + h), g / (g + k)
