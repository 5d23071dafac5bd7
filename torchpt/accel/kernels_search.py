"""Closest and any hits of a range of rays (numba): packets where sixteen rays go together, the others in turn."""

from __future__ import annotations

import numpy as np
from numba import prange

from torchpt.accel.kernels_packet import RAYS, SPARE, coherent, packet
from torchpt.accel.kernels_turn import SCRATCH, STATE, TURNS, turn
from torchpt.native.jit import jit, part
from torchpt.native.simd import pointer, put

__all__ = ["blocked", "blocked_parallel", "nearest", "nearest_parallel"]

WAITING = 2048  # rays that are collected before they go in turn


@part(inline="always")
def _trace(first, last, rays, scene, room, chosen, work, spare, out, any_hit):
    """Both kernels, on pointers."""
    i = first
    while i < last:
        count = np.int64(0)
        while i < last and count <= WAITING - RAYS:
            stop = min(i + RAYS, last)
            together, axis, ux, uy, uz = False, 0, False, False, False
            if stop - i == RAYS:
                together, axis, ux, uy, uz = coherent(rays, i)
            if together:
                packet(i, axis, ux, uy, uz, rays, scene, (work[0], work[1]), spare, out, any_hit)
            else:
                for j in range(i, stop):
                    put(chosen, count, np.int32(j))
                    count += 1
            i = stop
        if count > 0:
            turn(chosen, count, rays, scene, room, work, out, any_hit)


@part(inline="always")
def _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v, any_hit):
    """:func:`_trace` with its memory."""
    room = kinds[4]
    keys, parents = np.empty(TURNS * room, np.int32), np.empty(TURNS * room, np.int32)
    state, slots, scratch = np.empty(STATE, np.float32), np.empty(STATE, np.int64), np.empty(SCRATCH, np.float32)
    chosen, lanes, ids = np.empty(WAITING, np.int32), np.empty(SPARE, np.float32), np.empty(RAYS, np.int32)
    rays = (pointer(o), pointer(d), pointer(t_max), d.shape[1])
    tables = (pointer(corner), pointer(rows), pointer(quadrics))
    scene = (pointer(tree), pointer(codes), tables, pointer(kinds))
    work = (pointer(keys), pointer(parents), pointer(state), pointer(slots), pointer(scratch))
    spare, out = (pointer(lanes), pointer(ids)), (pointer(t), pointer(prim), pointer(u), pointer(v))
    _trace(first, last, rays, scene, room, pointer(chosen), work, spare, out, any_hit)
    # what pointers point to lives until here
    keys[0], parents[0], state[0], slots[0], scratch[0] = 0, 0, 0, 0, 0
    chosen[0], lanes[0], ids[0] = 0, 0, 0


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
        quadrics: ``(Q, 13)`` float64.
        kinds: ``(5,)`` int64: ids of the first rectangle, disk, sphere and quadric; room of a stack.
        t: ``(N,)`` float32, filled; inf for a miss.
        prim: ``(N,)`` int32, filled; -1 for a miss.
        u: ``(N,)`` float32, filled.
        v: ``(N,)`` float32, filled.
    """
    _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v, False)


@jit(parallel=True)
def nearest_parallel(chunks, items, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v):
    """:func:`nearest` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        nearest(a, b, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t, prim, u, v)


@jit()
def blocked(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, out):
    """1 in ``out`` ``(N,)`` int32 for each of the rays ``first <= i < last`` that hits anything, else 0."""
    _search(first, last, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, t_max, out, t_max, t_max, True)


@jit(parallel=True)
def blocked_parallel(chunks, items, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, out):
    """:func:`blocked` over equal chunks of the rays, one a thread."""
    for c in prange(chunks):
        a, b = c * items // chunks, (c + 1) * items // chunks
        blocked(a, b, o, d, t_max, tree, codes, corner, rows, quadrics, kinds, out)
