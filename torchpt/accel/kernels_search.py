"""Closest and any hits of a range of rays (numba): packets where sixteen rays go together, the others in turn."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.kernels_packet import RAYS, SPARE, coherent, deliver, packet
from torchpt.accel.kernels_rays import BEST, COLUMNS, FLOATS, IDS, NUMBERS, U, V, prepare
from torchpt.accel.kernels_turn import SCRATCH, STATE, TURNS, turn
from torchpt.native.jit import jit, part
from torchpt.native.simd import item, load, pointer, put

__all__ = ["PIECES", "blocked", "blocked_parallel", "nearest", "nearest_parallel"]


#: Pieces of work a thread: rays of one place may take longer than those of another.
PIECES = 8


@part(inline="always")
def _trace(first, last, rays, scene, room, groups, columns, work, spare, out, any_hit):
    """Rays ``first`` to ``last``, a multiple of 16."""
    rows, ids = columns
    i, count = first, np.int64(0)
    while i < last:
        good = prepare(i, rays, count, rows, ids)
        together, ux, uy, uz = coherent(count, good, rows)
        if together:
            packet(i, count, good, ux, uy, uz, rows, ids, scene, (work[0], work[1]), spare, out, any_hit)
        else:
            put(groups, count >> 4, i)
            count += 16
        i += 16
        if count == COLUMNS or (i >= last and count > 0):
            turn(count, scene, room, rows, ids, work, any_hit)
            for k in range(count >> 4):
                best, u, v = load(rows, BEST + 16 * k, 16), load(rows, U + 16 * k, 16), load(rows, V + 16 * k, 16)
                deliver(item(groups, k), out, best, load(ids, IDS + 16 * k, 16), u, v, any_hit)
            count = np.int64(0)


@part()
def _none():
    return np.empty(0, np.uint8)


@part(inline="always")
def _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, non_opaque, t, prim, u, v, any_hit):
    """:func:`_trace` with its memory; the rays beyond the last sixteen in memory of their own."""
    room = kinds[4]
    keys, parents = np.empty(TURNS * room, np.int32), np.empty(TURNS * room, np.int32)
    slots, scratch, groups = np.empty(STATE, np.int64), np.empty(SCRATCH, np.float32), np.empty(COLUMNS >> 4, np.int64)
    columns, numbers = np.empty(FLOATS, np.float32), np.empty(NUMBERS, np.int32)
    lanes, kept = np.empty(SPARE, np.float32), np.empty(RAYS, np.int32)
    tables = (pointer(corner), pointer(rows), pointer(quadrics))
    scene = (pointer(tree), pointer(codes), tables, pointer(kinds), pointer(non_opaque), len(non_opaque))
    work = (pointer(keys), pointer(parents), pointer(slots), pointer(scratch))
    held = (pointer(columns), pointer(numbers))
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
        _trace(start, stop, rays, scene, room, pointer(groups), held, work, spare, out, any_hit)
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
        tree: blocks of nodes and leaves, see :mod:`torchpt.accel.kernels_blocks`.
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
