"""One ray against one quadric in its own space (numba): the operations of ``leaf.quadric``, in the same order."""

from __future__ import annotations

import math

import numpy as np

from torchpt.native.jit import part
from torchpt.native.simd import item

__all__ = ["quadric_hit"]

_INF = np.float64(np.inf)
_NAN32 = np.float32(np.nan)


@part(forceinline=True)
def _sign(x):
    return math.copysign(1.0, x)


@part(forceinline=True)
def _diamond(x, y):
    """Way along the square ``|x| + |y| = 1`` from +x to a direction: in [-2, 2], monotonic in the angle."""
    s = abs(x) + abs(y)
    c = abs(x) / s if s > 0.0 else 1.0
    return (1.0 - c if x >= 0.0 else 1.0 + c) * _sign(y)


@part()
def quadric_hit(table, k, ox, oy, oz, dx, dy, dz):
    """``t, u, v`` as float32 of the nearest positive root on quadric ``k`` of ``table (Q, 19)``; ``t`` is NaN for a miss.

    See :func:`torchpt.accel.leaf.quadric` for the formulas and what ``u, v`` are.
    """
    px, py, pz = np.float64(ox), np.float64(oy), np.float64(oz)
    rx, ry, rz = np.float64(dx), np.float64(dy), np.float64(dz)
    fx = (
        item(table, 19 * k + 0) * px
        + item(table, 19 * k + 1) * py
        + item(table, 19 * k + 2) * pz
        + item(table, 19 * k + 3)
    )
    fy = (
        item(table, 19 * k + 4) * px
        + item(table, 19 * k + 5) * py
        + item(table, 19 * k + 6) * pz
        + item(table, 19 * k + 7)
    )
    fz = (
        item(table, 19 * k + 8) * px
        + item(table, 19 * k + 9) * py
        + item(table, 19 * k + 10) * pz
        + item(table, 19 * k + 11)
    )
    ex = item(table, 19 * k + 0) * rx + item(table, 19 * k + 1) * ry + item(table, 19 * k + 2) * rz
    ey = item(table, 19 * k + 4) * rx + item(table, 19 * k + 5) * ry + item(table, 19 * k + 6) * rz
    ez = item(table, 19 * k + 8) * rx + item(table, 19 * k + 9) * ry + item(table, 19 * k + 10) * rz
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
    ok1 = t1 > 0.0 and t1 < _INF and z1 >= low and z1 <= high
    ok2 = t2 > 0.0 and t2 < _INF and z2 >= low and z2 <= high
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
