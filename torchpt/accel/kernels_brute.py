"""The packet kernels of the brute-force search (numba)."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from torchpt.accel.kernels_quadric import quadric_hit
from torchpt.accel.kernels_sphere import sphere_distance
from torchpt.native.jit import jit

__all__ = ["BLOCK", "intersect", "intersect_parallel", "occluded", "occluded_parallel"]

#: Rays a block. The inner loops' trip count is this constant: a variable one runs eight times slower.
BLOCK = 64
_FAST = {"contract", "nsz"}  # never nnan or ninf: infinities and NaN are legal here and mean "no hit"
# The work table is flat: constant offsets from one array need no alias checks.
_OX, _OY, _OZ, _DX, _DY, _DZ, _REACH, _T, _PRIM = range(0, 9 * BLOCK, BLOCK)
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_TWO = np.float32(2.0)
_DEAD = np.float32(-1.0)


@jit()
def _load(block, o, d, t_max, extent, w):
    """Copies a block of rays to the work table, dead and missing ones with t = -1."""
    start = block * BLOCK
    count = min(BLOCK, t_max.shape[0] - start)
    if count < BLOCK:
        for i in range(_T + BLOCK):
            w[i] = _DEAD
    # Views of one row each, not indices from `start`: those might be negative for all the compiler knows, and would
    # stay scalar code.
    for c in range(3):
        origin, direction = o[c, start : start + count], d[c, start : start + count]
        for i in range(count):
            w[c * BLOCK + i] = origin[i]
        for i in range(count):
            w[(3 + c) * BLOCK + i] = direction[i]
    reach = t_max[start : start + count]
    for i in range(count):
        w[_T + i] = reach[i]
    for i in range(BLOCK):
        ox, oy, oz, dx, dy, dz = w[_OX + i], w[_OY + i], w[_OZ + i], w[_DX + i], w[_DY + i], w[_DZ + i]
        nothing = (
            ox * _ZERO + oy * _ZERO + oz * _ZERO + dx * _ZERO + dy * _ZERO + dz * _ZERO
        )  # NaN unless all are finite
        good = (nothing == _ZERO) & (w[_T + i] > _ZERO)
        far_o, far_d = max(max(abs(ox), abs(oy)), abs(oz)), max(max(abs(dx), abs(dy)), abs(dz))
        w[_REACH + i] = far_d * max(far_o, extent)
        w[_T + i] = w[_T + i] if good else _DEAD
        w[_PRIM + i] = _DEAD


@jit(forceinline=True)
def _unpack(x):
    """A row as values: loads that the stores into the work table could alias would not leave the loop."""
    return x[0], x[1], x[2], x[3], x[4], x[5], x[6], x[7], x[8], x[9], x[10], x[11], x[12]


@jit(fastmath=_FAST, forceinline=True)
def _plane(row, w, i):
    """Distance, parameters and accepted rounding error of ray i at a primitive's plane."""
    nx, ny, nz, c, ax, ay, az, ca, bx, by, bz, cb, tolerance = row
    ox, oy, oz, dx, dy, dz = w[_OX + i], w[_OY + i], w[_OZ + i], w[_DX + i], w[_DY + i], w[_DZ + i]
    inv = _ONE / (nx * dx + ny * dy + nz * dz)
    t = -(nx * ox + ny * oy + nz * oz + c) * inv
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    return t, ax * x + ay * y + az * z + ca, bx * x + by * y + bz * z + cb, abs(w[_REACH + i] * inv) * tolerance


@jit(fastmath=_FAST, forceinline=True)
def _in_triangle(u, v, slack):
    return (u >= -slack) & (v >= -slack) & (u + v <= _ONE + _TWO * slack)


@jit(fastmath=_FAST, forceinline=True)
def _in_rectangle(u, v, slack):
    return (u >= -slack) & (v >= -slack) & (u <= _ONE + slack) & (v <= _ONE + slack)


@jit(forceinline=True)
def _ball(ball, w, i):
    ox, oy, oz, dx, dy, dz = w[_OX + i], w[_OY + i], w[_OZ + i], w[_DX + i], w[_DY + i], w[_DZ + i]
    return sphere_distance(ox, oy, oz, dx, dy, dz, ball[0], ball[1], ball[2], ball[3])


@jit(forceinline=True)
def _keep(hit, t, prim, w, i, any_hit):
    """Takes a hit that is nearer than what there is; of any hit the ray is dead then."""
    if any_hit:
        w[_T + i] = _DEAD if hit else w[_T + i]
    else:
        w[_T + i] = t if hit else w[_T + i]
        w[_PRIM + i] = prim if hit else w[_PRIM + i]


@jit(fastmath=_FAST, forceinline=True)
def _triangle(row, prim, w, any_hit):
    r = _unpack(row)
    for i in range(BLOCK):
        t, u, v, slack = _plane(r, w, i)
        _keep(_in_triangle(u, v, slack) & (t > _ZERO) & (t < w[_T + i]), t, prim, w, i, any_hit)


@jit(fastmath=_FAST, forceinline=True)
def _rectangle(row, prim, w, any_hit):
    r = _unpack(row)
    for i in range(BLOCK):
        t, u, v, slack = _plane(r, w, i)
        _keep(_in_rectangle(u, v, slack) & (t > _ZERO) & (t < w[_T + i]), t, prim, w, i, any_hit)


@jit(fastmath=_FAST, forceinline=True)
def _disk(row, prim, w, any_hit):
    r = _unpack(row)
    for i in range(BLOCK):
        t, u, v, _ = _plane(r, w, i)
        _keep((u * u + v * v <= _ONE) & (t > _ZERO) & (t < w[_T + i]), t, prim, w, i, any_hit)


@jit(forceinline=True)
def _sphere(ball, prim, w, any_hit):
    for i in range(BLOCK):
        t = _ball(ball, w, i)
        _keep((t > _ZERO) & (t < w[_T + i]), t, prim, w, i, any_hit)


@jit()
def _bent(quadrics, k, w, i):
    """``t, u, v`` of ray i at a quadric."""
    ox, oy, oz, dx, dy, dz = w[_OX + i], w[_OY + i], w[_OZ + i], w[_DX + i], w[_DY + i], w[_DZ + i]
    return quadric_hit(quadrics, k, ox, oy, oz, dx, dy, dz)


@jit(forceinline=True)
def _quadric(quadrics, k, prim, w, any_hit):
    for i in range(BLOCK):
        if w[_T + i] > _ZERO:
            t, _, _ = _bent(quadrics, k, w, i)
            _keep((t > _ZERO) & (t < w[_T + i]), t, prim, w, i, any_hit)


@jit()
def _all_dead(w):
    top = _DEAD
    for i in range(BLOCK):
        top = max(top, w[_T + i])
    return top < _ZERO


@jit(fastmath=_FAST)
def _store(block, table, triangles, rectangles, w, t, prim, u, v):
    """Writes a block's hits; parameters in the slack beyond an edge are brought back to the edge."""
    start = block * BLOCK
    count = min(BLOCK, t.shape[0] - start)
    t, prim, u, v = (
        t[start : start + count],
        prim[start : start + count],
        u[start : start + count],
        v[start : start + count],
    )
    for i in range(count):
        p = np.int32(w[_PRIM + i])
        distance, a, b = w[_T + i], _ZERO, _ZERO
        if 0 <= p < table.shape[0]:
            x, y, z = (
                w[_OX + i] + distance * w[_DX + i],
                w[_OY + i] + distance * w[_DY + i],
                w[_OZ + i] + distance * w[_DZ + i],
            )
            a = table[p, 4] * x + table[p, 5] * y + table[p, 6] * z + table[p, 7]
            b = table[p, 8] * x + table[p, 9] * y + table[p, 10] * z + table[p, 11]
            if p < triangles + rectangles:
                a = min(max(a, _ZERO), _ONE)
                b = min(max(b, _ZERO), _ONE if p >= triangles else _ONE - a)
        t[i] = distance if p >= 0 else np.float32(math.inf)
        prim[i] = p
        u[i] = a
        v[i] = b


@jit()
def _store_quadrics(block, quadrics, first, w, prim, u, v):
    """Writes the parameters of a block's hits on quadrics, which come with the distance."""
    start = block * BLOCK
    for i in range(min(BLOCK, prim.shape[0] - start)):
        if prim[start + i] >= first:
            _, u[start + i], v[start + i] = _bent(quadrics, prim[start + i] - first, w, i)


@jit()
def intersect(first, last, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, t, prim, u, v):
    """Nearest hits of the blocks ``first <= b < last``; ascending ids and a strict comparison settle ties."""
    w = np.empty(9 * BLOCK, np.float32)
    for block in range(first, last):
        _load(block, o, d, t_max, extent, w)
        if not _all_dead(w):
            for p in range(triangles):
                _triangle(table[p], np.float32(p), w, False)
            for p in range(triangles, triangles + rectangles):
                _rectangle(table[p], np.float32(p), w, False)
            for p in range(triangles + rectangles, table.shape[0]):
                _disk(table[p], np.float32(p), w, False)
            for p in range(balls.shape[0]):
                _sphere(balls[p], np.float32(p + table.shape[0]), w, False)
            for p in range(quadrics.shape[0]):
                _quadric(quadrics, p, np.float32(p + table.shape[0] + balls.shape[0]), w, False)
        _store(block, table, triangles, rectangles, w, t, prim, u, v)
        if quadrics.shape[0] > 0:
            _store_quadrics(block, quadrics, table.shape[0] + balls.shape[0], w, prim, u, v)


@jit(parallel=True)
def intersect_parallel(
    chunks, items, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, t, prim, u, v
):
    """:func:`intersect` over equal chunks of the blocks, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        intersect(a, b, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, t, prim, u, v)


@jit()
def _shade(table, balls, quadrics, triangles, rectangles, w):
    """Marks the blocked rays of a block as dead; stops once none is left."""
    for p in range(table.shape[0]):
        if p < triangles:
            _triangle(table[p], _DEAD, w, True)
        elif p < triangles + rectangles:
            _rectangle(table[p], _DEAD, w, True)
        else:
            _disk(table[p], _DEAD, w, True)
        if p % 8 == 7 and _all_dead(w):
            return
    for p in range(balls.shape[0]):
        _sphere(balls[p], _DEAD, w, True)
    for p in range(quadrics.shape[0]):
        _quadric(quadrics, p, _DEAD, w, True)


@jit()
def occluded(first, last, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, blocked):
    """Whether the rays of the blocks ``first <= b < last`` hit anything."""
    w = np.empty(9 * BLOCK, np.float32)
    alive = np.empty(BLOCK, np.bool_)
    for block in range(first, last):
        _load(block, o, d, t_max, extent, w)
        for i in range(BLOCK):
            alive[i] = w[_T + i] > _ZERO
        if not _all_dead(w):
            _shade(table, balls, quadrics, triangles, rectangles, w)
        for i in range(min(BLOCK, t_max.shape[0] - block * BLOCK)):
            blocked[block * BLOCK + i] = alive[i] and w[_T + i] < _ZERO


@jit(parallel=True)
def occluded_parallel(
    chunks, items, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, blocked
):
    """:func:`occluded` over equal chunks of the blocks, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        occluded(a, b, o, d, t_max, table, balls, quadrics, triangles, rectangles, disks, extent, blocked)
