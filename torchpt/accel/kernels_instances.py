"""Copies of meshes (numba): a tree over their boxes, and for each that is met the tree of its mesh."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.kernels_blocks import IDS, SLACK, boxes, fits, place, push
from torchpt.accel.kernels_leaf import setup
from torchpt.accel.kernels_search import PIECES
from torchpt.accel.kernels_single import SCRATCH, nearest_of, pop
from torchpt.native.jit import jit, part
from torchpt.native.simd import item, pointer, put, splat

__all__ = ["blocked", "blocked_parallel", "nearest", "nearest_parallel"]

_ZERO, _INF = np.float32(0.0), np.float32(np.inf)


@part(forceinline=True)
def _row(table, k, x, y, z):
    """Three float64 numbers of an affine map's row with a point, without its last number."""
    return item(table, k) * x + item(table, k + 1) * y + item(table, k + 2) * z


@part()
def _moved(table, copy, o, d):
    """A ray in the place of a copy's mesh: moved in float64, rounded to float32."""
    k = 12 * copy
    px, py, pz = np.float64(o[0]), np.float64(o[1]), np.float64(o[2])
    rx, ry, rz = np.float64(d[0]), np.float64(d[1]), np.float64(d[2])
    at = (
        np.float32(_row(table, k, px, py, pz) + item(table, k + 3)),
        np.float32(_row(table, k + 4, px, py, pz) + item(table, k + 7)),
        np.float32(_row(table, k + 8, px, py, pz) + item(table, k + 11)),
    )
    along = (
        np.float32(_row(table, k, rx, ry, rz)),
        np.float32(_row(table, k + 4, rx, ry, rz)),
        np.float32(_row(table, k + 8, rx, ry, rz)),
    )
    return at, along


@part()
def _ray(o, d, best, prim, upper, lower, copies, work, any_hit):
    """The nearest hit of one ray among the copies where it is nearer than ``best``, or any such hit: ``t, prim, u, v``."""
    tree, codes = upper
    table, shift, roots = copies
    keys, parents, scratch = work
    _, _, _, _, _, _, ix, iy, iz = setup(d[0], d[1], d[2])
    nx, ny, nz = 0 if ix > _ZERO else 24, 8 if iy > _ZERO else 32, 16 if iz > _ZERO else 40
    u, v = _ZERO, _ZERO
    top, code, first = np.int64(0), np.int64(0), prim
    while top >= 0:
        base = place(code)
        if code >= 0:
            a, met = boxes(
                tree, base, nx, ny, nz, splat(o[0], 8), splat(o[1], 8), splat(o[2], 8),
                splat(ix, 8), splat(iy, 8), splat(iz, 8), splat(best, 8),
            )  # fmt: skip
            top = push(keys, parents, top, base, a, met)
        else:
            for k in range(8):
                copy = np.int64(-2) - item(codes, base + IDS + k)
                if copy < 0:
                    continue
                at, along = _moved(table, copy, o, d)
                had = prim
                best, prim, a, b = nearest_of(
                    lower, item(roots, copy), at, along, best, prim, item(shift, copy),
                    keys, parents, top, scratch, any_hit,
                )  # fmt: skip
                if prim != had:
                    u, v = a, b
            if any_hit and prim != first:
                break
        top, code, _ = pop(codes, keys, parents, top, 0, best * SLACK)
    return best, prim, u, v


@part(inline="always")
def _search(
    first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, t, prim, u, v, any_hit
):
    keys, parents, scratch = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(SCRATCH, np.float32)
    none = np.empty(1, np.uint8)
    work = (pointer(keys), pointer(parents), pointer(scratch))
    above, below = (
        (pointer(upper), pointer(upper_codes)),
        (pointer(lower), pointer(lower_codes), 0, 0, pointer(none), 0),
    )
    copies = (pointer(table), pointer(shift), pointer(roots))
    for i in range(first, last):
        p, r = (o[0, i], o[1, i], o[2, i]), (d[0, i], d[1, i], d[2, i])
        if not fits(p[0], p[1], p[2], r[0], r[1], r[2], t_max[i]):
            continue
        if any_hit:
            if prim[i] == 0:
                _, found, _, _ = _ray(p, r, t_max[i], np.int32(-1), above, below, copies, work, True)
                prim[i] = 1 if found >= 0 else 0
        else:
            best, found, a, b = _ray(p, r, min(t[i], t_max[i]), prim[i], above, below, copies, work, False)
            if found != prim[i]:
                put(prim, i, found)
                t[i], u[i], v[i] = best, a, b
    keys[0], parents[0], scratch[0], none[0] = 0, 0, 0, 0  # what pointers point to lives until here


@jit()
def nearest(first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, t, prim, u, v):
    """Takes the copies into the hits of the rays ``first <= i < last``.

    Args:
        first: ray.
        last: ray.
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        t_max: ``(N,)``.
        upper: blocks of the tree over the copies' boxes.
        upper_codes: the same memory as int32.
        lower: blocks of the trees of all meshes, one after the other.
        lower_codes: the same memory as int32.
        table: ``(I, 12)`` float64 maps from the world to the meshes.
        shift: ``(I,)`` int32 from a triangle's number in its mesh to its id in the copy.
        roots: ``(I,)`` int64 codes of the meshes' roots.
        room: entries of the stack.
        t: found so far, inf for none.
        prim: found so far, -1 for none.
        u: found so far.
        v: found so far.
    """
    _search(
        first,
        last,
        o,
        d,
        t_max,
        upper,
        upper_codes,
        lower,
        lower_codes,
        table,
        shift,
        roots,
        room,
        t,
        prim,
        u,
        v,
        False,
    )


@jit(parallel=True)
def nearest_parallel(
    chunks, items, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, t, prim, u, v
):
    """:func:`nearest` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            nearest(a, b, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, t, prim, u, v)


@jit()
def blocked(first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, out):
    """Puts 1 in ``out (N,)`` for rays that hit a copy; those that have it already are left alone."""
    _search(
        first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room,
        t_max, out, t_max, t_max, True,
    )  # fmt: skip


@jit(parallel=True)
def blocked_parallel(
    chunks, items, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, out
):
    """:func:`blocked` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            blocked(a, b, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, room, out)
