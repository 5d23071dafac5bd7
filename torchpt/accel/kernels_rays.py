"""Rays as the search takes them (numba): sixteen at a time, in columns."""

from __future__ import annotations

import numpy as np

from torchpt.native.jit import part
from torchpt.native.simd import absolute, as_float, as_int, bits, load, maximum, select, splat, store

__all__ = [
    "AXIS",
    "BEST",
    "COLUMNS",
    "DIRECTION",
    "FLOATS",
    "IDS",
    "INVERSE",
    "NEAR",
    "NUMBERS",
    "ORIGIN",
    "SHEAR",
    "U",
    "V",
    "prepare",
]

#: Rays that are held at a time; the length of a row.
COLUMNS = 256
#: Rows of float32: origin, direction, reciprocal direction, shear, best distance (-1: nothing is to be found), u, v.
ORIGIN, DIRECTION, INVERSE, SHEAR, BEST, U, V = (k * COLUMNS for k in (0, 3, 6, 9, 12, 13, 14))
FLOATS = 15 * COLUMNS
#: Rows of int32: the axes with the direction's longest last, where the planes that face the ray begin, the primitive hit.
AXIS, NEAR, IDS = 0, 3 * COLUMNS, 6 * COLUMNS
NUMBERS = 7 * COLUMNS
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST, _TINY = np.float32(1e-20), np.float32(1e-37)  # as in kernels_leaf.setup


@part(forceinline=True)
def _inverse(d, least):
    """Reciprocals that are never infinite."""
    sign = as_int(d) & splat(np.int32(-(2**31)), 16)
    return splat(_ONE, 16) / select(absolute(d) >= least, d, as_float(as_int(least) | sign))


@part(forceinline=True)
def _facing(inverse, at):
    return select(inverse > splat(_ZERO, 16), splat(np.int32(at), 16), splat(np.int32(at + 24), 16))


@part(forceinline=True)
def prepare(i, rays, c, rows, ids):
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
    store(ids, IDS + c, splat(np.int32(-1), 16))
    return bits(good)
