"""Several single rays in turn, one block each (numba): while the block of one is on its way from memory, others work."""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import FLOOR, SLACK, boxes, crossed, fetch, place, push, triangles_alone
from torchpt.accel.kernels_others import others
from torchpt.accel.kernels_rays import AXIS, BEST, COLUMNS, DIRECTION, IDS, INVERSE, NEAR, ORIGIN, SHEAR, U, V
from torchpt.accel.kernels_single import SCRATCH, blocker, nearer, pop
from torchpt.native.jit import part
from torchpt.native.simd import as_float, bits, item, put, splat

__all__ = ["SCRATCH", "STATE", "TURNS", "turn"]

TURNS = 16  # rays in flight
_ROW = 4
STATE = TURNS * _ROW
_ZERO = np.float32(0.0)
#: Places in a row of int64: column of the ray, next code, its key, top of the stack (below 0: no ray is left).
_RAY, _CODE, _KEY, _TOP = 0, 1, 2, 3


@part(forceinline=True)
def _splats(rows, at):
    return splat(item(rows, at), 8), splat(item(rows, at + COLUMNS), 8), splat(item(rows, at + 2 * COLUMNS), 8)


@part(forceinline=True)
def _scalars(rows, at):
    return item(rows, at), item(rows, at + COLUMNS), item(rows, at + 2 * COLUMNS)


@part(forceinline=True)
def _leaf(scene, code, key, c, rows, ids, scratch, any_hit):
    """Tests a leaf and writes down what is nearer; returns whether an any-hit ray is settled."""
    tree, codes = scene[0], scene[1]
    base, mixed = place(code), not triangles_alone(code)
    kx, ky, kz = _scalars(ids, AXIS + c)
    axes = (np.int64(kx), np.int64(ky), np.int64(kz))
    px, py, pz = (
        item(rows, ORIGIN + axes[0] * COLUMNS + c), item(rows, ORIGIN + axes[1] * COLUMNS + c),
        item(rows, ORIGIN + axes[2] * COLUMNS + c),
    )  # fmt: skip
    sx, sy = splat(item(rows, SHEAR + c), 8), splat(item(rows, SHEAR + COLUMNS + c), 8)
    met = crossed(tree, base, axes[0], axes[1], axes[2], splat(px, 8), splat(py, 8), splat(pz, 8), sx, sy)
    if bits(met[0]) == 0 and not mixed:
        return False
    best, had = item(rows, BEST + c), item(ids, IDS + c)
    floor = as_float(key & -8) * FLOOR
    o, d, shear = _scalars(rows, ORIGIN + c), _scalars(rows, DIRECTION + c), _scalars(rows, SHEAR + c)
    if any_hit:
        q = blocker(scene, base, met, shear[2], o, d, floor, best, had, np.int32(0)) if bits(met[0]) != 0 else had
        if mixed and q < 0:
            _, q, _, _ = others(scene, code, base, o, d, axes, shear, floor, best, q, scratch, any_hit)
        put(ids, IDS + c, q)
        return q >= 0
    best, q, lane = nearer(tree, codes, base, met, shear[2], o, d, floor, best, had, np.int32(0), scratch)
    if lane >= 0:
        put(rows, U + c, item(scratch, 8 + lane))
        put(rows, V + c, item(scratch, 16 + lane))
    if mixed:
        before = q
        best, q, a, b = others(scene, code, base, o, d, axes, shear, floor, best, q, scratch, any_hit)
        if q != before:
            put(rows, U + c, a)
            put(rows, V + c, b)
    if q != had:
        put(rows, BEST + c, best)
        put(ids, IDS + c, q)
    return False


@part(forceinline=True)
def turn(count, scene, room, rows, ids, work, any_hit):
    """The nearest hits of the rays in the first ``count`` columns, or any hits.

    Args:
        count: how many columns.
        scene: the tree as float32 and as int32, tables of other primitives, where their kinds begin.
        room: entries of a ray's stack.
        rows: rays, see :mod:`torchpt.accel.kernels_rays`.
        ids: likewise.
        work: memory: keys and parents of the stacks (``TURNS * room`` int32 each), ``STATE`` int64, ``SCRATCH`` float32.
        any_hit: whether any hit will do.
    """
    tree, codes = scene[0], scene[1]
    keys, parents, slots, scratch = work
    at, live = np.int64(0), np.int64(0)
    for r in range(TURNS):
        while at < count and not item(rows, BEST + at) > _ZERO:
            at += 1
        if at < count:
            put(slots, r * _ROW + _RAY, at)
            put(slots, r * _ROW + _CODE, 0)
            put(slots, r * _ROW + _TOP, 0)
            at += 1
            live += 1
    flying = live
    while live > 0:
        for r in range(flying):
            s, bottom = r * _ROW, r * room
            top = bottom + item(slots, s + _TOP)
            if top < bottom:
                continue
            c, code = item(slots, s + _RAY), item(slots, s + _CODE)
            ended = False
            key = np.int32(0)
            if code >= 0:
                base = place(code)
                nx, ny, nz = _scalars(ids, NEAR + c)
                ox, oy, oz = _splats(rows, ORIGIN + c)
                ix, iy, iz = _splats(rows, INVERSE + c)
                a, met = boxes(
                    tree, base, np.int64(nx), np.int64(ny), np.int64(nz), ox, oy, oz, ix, iy, iz,
                    splat(item(rows, BEST + c), 8),
                )  # fmt: skip
                top = push(keys, parents, top, base, a, met)
            else:
                ended = _leaf(scene, code, item(slots, s + _KEY), c, rows, ids, scratch, any_hit)
            if not ended:
                top, code, key = pop(codes, keys, parents, top, bottom, item(rows, BEST + c) * SLACK)
                ended = top < bottom
            if ended:
                while at < count and not item(rows, BEST + at) > _ZERO:
                    at += 1
                if at == count:
                    put(slots, s + _TOP, -1)
                    live -= 1
                    continue
                put(slots, s + _RAY, at)
                at += 1
                top, code = bottom, np.int64(0)
            put(slots, s + _TOP, top - bottom)
            put(slots, s + _CODE, code)
            put(slots, s + _KEY, np.int64(key))
            fetch(tree, code)
