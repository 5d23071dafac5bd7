"""Several single rays in turn, one block each (numba): while the block of one is on its way from memory, others work."""

from __future__ import annotations

import numpy as np

from torchpt.accel.kernels_blocks import FLOOR, SLACK, boxes, crossed, fetch, fits, others, place, push
from torchpt.accel.kernels_leaf import setup
from torchpt.accel.kernels_single import SCRATCH, nearer, pop
from torchpt.native.jit import part
from torchpt.native.simd import as_float, bits, item, put, splat

__all__ = ["SCRATCH", "STATE", "TURNS", "turn"]

TURNS = _RAYS = 16  # rays in flight
_ROW = 16  # numbers of state a ray: one or two cache lines
STATE = _RAYS * _ROW
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)
#: Places in a row of float32: origin, reciprocal direction, origin by axes, shear, direction, best distance.
_O, _INVERSE, _PERMUTED, _SHEAR, _D, _BEST = 0, 3, 6, 9, 12, 15
#: Places in a row of int64: next code, top of the stack (or one of the two below), ray, near planes, axes, key of the code.
_CODE, _TOP, _RAY, _NEAR, _AXES, _KEY = 0, 1, 2, 3, 6, 9
_WANTING, _DONE = -1, -2


@part(forceinline=True)
def _clear(i, out, any_hit):
    """The result of a ray that hits nothing."""
    t, prim, u, v = out
    put(prim, i, np.int32(0) if any_hit else np.int32(-1))
    if not any_hit:
        put(t, i, _INF)
        put(u, i, _ZERO)
        put(v, i, _ZERO)


@part(forceinline=True)
def _take(i, rays, f, k, state, slots):
    """Sets up ray ``i`` in rows ``f`` and ``k``; returns whether it can hit anything."""
    o, d, t_max, n = rays
    o0, o1, o2 = item(o, i), item(o, n + i), item(o, 2 * n + i)
    d0, d1, d2, best = item(d, i), item(d, n + i), item(d, 2 * n + i), item(t_max, i)
    kx, ky, kz, sx, sy, sz, ix, iy, iz = setup(d0, d1, d2)
    put(state, f, o0)
    put(state, f + 1, o1)
    put(state, f + 2, o2)
    put(state, f + _INVERSE, ix)
    put(state, f + _INVERSE + 1, iy)
    put(state, f + _INVERSE + 2, iz)
    put(state, f + _PERMUTED, item(o, kx * n + i))
    put(state, f + _PERMUTED + 1, item(o, ky * n + i))
    put(state, f + _PERMUTED + 2, item(o, kz * n + i))
    put(state, f + _SHEAR, sx)
    put(state, f + _SHEAR + 1, sy)
    put(state, f + _SHEAR + 2, sz)
    put(state, f + _D, d0)
    put(state, f + _D + 1, d1)
    put(state, f + _D + 2, d2)
    put(state, f + _BEST, best)
    put(slots, k + _CODE, 0)
    put(slots, k + _RAY, i)
    put(slots, k + _KEY, 0)
    put(slots, k + _NEAR, 0 if ix > _ZERO else 24)
    put(slots, k + _NEAR + 1, 8 if iy > _ZERO else 32)
    put(slots, k + _NEAR + 2, 16 if iz > _ZERO else 40)
    put(slots, k + _AXES, kx)
    put(slots, k + _AXES + 1, ky)
    put(slots, k + _AXES + 2, kz)
    return fits(o0, o1, o2, d0, d1, d2, best)


@part(forceinline=True)
def _node(tree, base, f, k, state, slots, keys, parents, top):
    """Tests a node's boxes and puts those that are met on the stack."""
    a, met = boxes(
        tree, base, item(slots, k + _NEAR), item(slots, k + _NEAR + 1), item(slots, k + _NEAR + 2),
        splat(item(state, f), 8), splat(item(state, f + 1), 8), splat(item(state, f + 2), 8),
        splat(item(state, f + _INVERSE), 8), splat(item(state, f + _INVERSE + 1), 8),
        splat(item(state, f + _INVERSE + 2), 8), splat(item(state, f + _BEST), 8),
    )  # fmt: skip
    return push(keys, parents, top, base, a, met)


@part(forceinline=True)
def _leaf(scene, code, base, f, k, state, slots, scratch, out, any_hit):
    """Tests a leaf and writes down what is nearer; returns whether an any-hit ray is settled."""
    tree, codes, tables, kinds = scene
    t, prim, u, v = out
    axes = (item(slots, k + _AXES), item(slots, k + _AXES + 1), item(slots, k + _AXES + 2))
    met = crossed(
        tree, base, axes[0], axes[1], axes[2], splat(item(state, f + _PERMUTED), 8),
        splat(item(state, f + _PERMUTED + 1), 8), splat(item(state, f + _PERMUTED + 2), 8),
        splat(item(state, f + _SHEAR), 8), splat(item(state, f + _SHEAR + 1), 8),
    )  # fmt: skip
    mixed = code & 1 == 0
    if bits(met[0]) == 0 and not mixed:
        return False
    i, best = item(slots, k + _RAY), item(state, f + _BEST)
    had = np.int32(-1) if any_hit else item(prim, i)
    floor = as_float(item(slots, k + _KEY) & -8) * FLOOR
    o = (item(state, f), item(state, f + 1), item(state, f + 2))
    d = (item(state, f + _D), item(state, f + _D + 1), item(state, f + _D + 2))
    sz = item(state, f + _SHEAR + 2)
    best, q, lane = nearer(tree, codes, base, met, sz, o, d, floor, best, had, np.int32(0), scratch, any_hit)
    if lane >= 0 and not any_hit:
        put(u, i, item(scratch, 8 + lane))
        put(v, i, item(scratch, 16 + lane))
    if mixed and not (any_hit and lane >= 0):
        before = q
        shear = (item(state, f + _SHEAR), item(state, f + _SHEAR + 1), sz)
        best, q, a, b = others(codes, base, tables, kinds, o, d, axes, shear, floor, best, q, any_hit)
        if q != before and not any_hit:
            put(u, i, a)
            put(v, i, b)
    if q == had:
        return False
    if any_hit:
        put(prim, i, np.int32(1))
    else:
        put(prim, i, q)
        put(t, i, best)
        put(state, f + _BEST, best)
    return any_hit


@part(forceinline=True)
def turn(chosen, count, rays, scene, room, work, out, any_hit):
    """The nearest hits of rays ``chosen[:count]``, or for each whether it hits anything (1 in the second of ``out``).

    Args:
        chosen: int32 places of rays.
        count: how many.
        rays: ``o, d, t_max`` and how many rays lie in a row of the first two.
        scene: the tree as float32 and as int32, tables of other primitives, where their kinds begin.
        room: entries of a ray's stack.
        work: memory: keys and parents of the stacks (``TURNS * room`` int32 each), ``STATE`` float32, ``STATE`` int64,
            ``SCRATCH`` float32.
        out: ``t, prim, u, v``.
        any_hit: whether any hit will do.
    """
    tree, codes = scene[0], scene[1]
    keys, parents, state, slots, scratch = work
    for r in range(_RAYS):
        put(slots, r * _ROW + _TOP, _WANTING)
    at, live = 0, _RAYS
    while live > 0:
        for r in range(_RAYS):
            f, k, bottom = r * _ROW, r * _ROW, r * room
            top = item(slots, k + _TOP)
            if top == _DONE:
                continue
            if top == _WANTING:
                found = False
                while at < count and not found:
                    i = np.int64(item(chosen, at))
                    at += 1
                    _clear(i, out, any_hit)
                    found = _take(i, rays, f, k, state, slots)
                if not found:
                    put(slots, k + _TOP, _DONE)
                    live -= 1
                    continue
                top = np.int64(0)
            code = item(slots, k + _CODE)
            base = place(code)
            settled = False
            if code >= 0:
                top = _node(tree, base, f, k, state, slots, keys, parents, bottom + top) - bottom
            else:
                settled = _leaf(scene, code, base, f, k, state, slots, scratch, out, any_hit)
            if settled:
                put(slots, k + _TOP, _WANTING)
                continue
            limit = item(state, f + _BEST) * SLACK
            top, code, key = pop(codes, keys, parents, bottom + top, bottom, limit)
            # a stack that is empty gives one below its bottom, which is what _WANTING says
            put(slots, k + _TOP, top - bottom)
            put(slots, k + _CODE, code)
            put(slots, k + _KEY, np.int64(key))
            fetch(tree, code)
