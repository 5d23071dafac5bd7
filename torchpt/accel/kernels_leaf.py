"""One ray against one primitive (numba): the operations of :mod:`torchpt.accel.leaf`, in the same order, none fused."""

from __future__ import annotations

import math

import numpy as np

from torchpt.accel.kernels_quadric import quadric_hit
from torchpt.accel.kernels_sphere import sphere_distance
from torchpt.native.jit import jit

__all__ = ["distance", "setup"]

_NAN = np.float32(np.nan)
_INF = np.float32(np.inf)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@jit(forceinline=True)
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


@jit(forceinline=True)
def _sheared(corner, prim, k, kx, ky, kz, px, py, pz, sx, sy, sz):
    x, y, z = corner[prim, k + kx] - px, corner[prim, k + ky] - py, corner[prim, k + kz] - pz
    return x - sx * z, y - sy * z, z * sz


@jit()
def distance(prim, corner, rows, quadrics, n1, n2, n3, n4, o, d, kx, ky, kz, sx, sy, sz):
    """``t, u, v`` of ray ``o, d`` (tuples) at a primitive; ``t`` is NaN where it misses.

    ``corner`` is ``(P, 12)``: p0, p1, p2 and a rectangle's fourth corner; ``n1`` to ``n4`` are the ids of the
    first rectangle, disk, sphere and quadric; the axes and the shear come from :func:`setup`.
    """
    if prim >= n3:
        if prim >= n4:
            return quadric_hit(quadrics, prim - n4, o[0], o[1], o[2], d[0], d[1], d[2])
        t = sphere_distance(
            o[0], o[1], o[2], d[0], d[1], d[2], corner[prim, 0], corner[prim, 1], corner[prim, 2],
            np.float64(corner[prim, 3]),
        )  # fmt: skip
        return t, _ZERO, _ZERO
    away = rows[prim, 0] * o[0] + rows[prim, 1] * o[1] + rows[prim, 2] * o[2] + rows[prim, 3]
    along = rows[prim, 0] * d[0] + rows[prim, 1] * d[1] + rows[prim, 2] * d[2]
    plane = -away / along
    if not (plane > _ZERO and plane < _INF):
        return _NAN, _ZERO, _ZERO
    if prim >= n2:
        x, y, z = o[0] + plane * d[0], o[1] + plane * d[1], o[2] + plane * d[2]
        u = rows[prim, 4] * x + rows[prim, 5] * y + rows[prim, 6] * z + rows[prim, 7]
        v = rows[prim, 8] * x + rows[prim, 9] * y + rows[prim, 10] * z + rows[prim, 11]
        return (plane if u * u + v * v <= _ONE else _NAN), u, v
    px, py, pz = o[kx], o[ky], o[kz]
    ax, ay, az = _sheared(corner, prim, 0, kx, ky, kz, px, py, pz, sx, sy, sz)
    bx, by, bz = _sheared(corner, prim, 3, kx, ky, kz, px, py, pz, sx, sy, sz)
    cx, cy, cz = _sheared(corner, prim, 6, kx, ky, kz, px, py, pz, sx, sy, sz)
    e = cx * by - cy * bx
    f = ax * cy - ay * cx
    g = bx * ay - by * ax
    near, far = min(min(az, bz), cz), max(max(az, bz), cz)
    if prim >= n1:
        qx, qy, qz = _sheared(corner, prim, 9, kx, ky, kz, px, py, pz, sx, sy, sz)
        h = qx * by - qy * bx
        k = cx * qy - cy * qx
        low, high = min(min(f, g), min(h, k)), max(max(f, g), max(h, k))
        det = (f + h) * (g + k)
        u, v = f / (f + h), g / (g + k)
        near, far = min(near, qz), max(far, qz)
    else:
        low, high = min(min(e, f), g), max(max(e, f), g)
        det = e + f + g
        u, v = f / det, g / det
    if not ((low >= _ZERO or high <= _ZERO) and det != _ZERO):
        return _NAN, _ZERO, _ZERO
    return min(max(plane, near), far), u, v
