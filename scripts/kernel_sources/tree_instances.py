"""Traverse instances of meshes: a tree over their boxes, and for each instance whose box a ray hits the tree of its mesh.

A *copy* is an instance, by index. In the leaves of the upper tree instances stand where ids of primitives do, as ``-2 - copy``.
For the names of values see :mod:`kernel_sources.tree_nodes`.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import BYTES, FLOATS, INT, INTS, LONGS, inner, kernel
from kernel_sources.simd import item, load_pointer, part, put, splat
from kernel_sources.tree_leaf import setup_ray
from kernel_sources.tree_nodes import block_offset, boxes, is_valid_ray, push
from kernel_sources.tree_single import SCRATCH, pop, trace_single
from torchpt.search.tree_layout import IDS, INSTANCE_MEMORY, SLACK

__all__ = ["nearest", "occluded"]

assert 4 * SCRATCH == INSTANCE_MEMORY
_ZERO = np.float32(0.0)


@inner(forceinline=True)
def _row(table, k, x, y, z):
    """Multiply the linear part of a row of an affine map with a point, in float64."""
    return item(table, k) * x + item(table, k + 1) * y + item(table, k + 2) * z


@inner()
def _moved(table, copy, o, d):
    """Transform a ray to the space of an instance's mesh, in float64, rounded to float32."""
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


@inner()
def _ray(o, d, best, prim, upper, lower, copies, work, any_hit):
    """Find the nearest hit of one ray with instances nearer than ``best``, or any such hit: ``t, prim, u, v``.

    Args:
        o: origin, a tuple.
        d: direction, a tuple.
        best: distance of the nearest hit so far, or ``t_max``.
        prim: id of that hit, or -1.
        upper: the upper tree as float32 and as int32.
        lower: the trees of the meshes, as the ``scene`` of :func:`kernel_sources.tree_single.trace_single`.
        copies: of the instances: transforms, shifts of ids, codes of the roots of their meshes.
        work: keys and parents of the stack, which both levels share, and scratch memory.
        any_hit: True: stop at the first hit.
    """
    tree, codes = upper
    table, shift, roots = copies
    keys, parents, scratch = work
    _, _, _, _, _, _, ix, iy, iz = setup_ray(d[0], d[1], d[2])
    nx, ny, nz = 0 if ix > _ZERO else 24, 8 if iy > _ZERO else 32, 16 if iz > _ZERO else 40
    u, v = _ZERO, _ZERO
    top, code, first = np.int64(0), np.int64(0), prim
    while top >= 0:
        base = block_offset(code)
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
                previous = prim
                best, prim, a, b = trace_single(
                    lower, item(roots, copy), at, along, best, prim, item(shift, copy),
                    keys, parents, top, scratch, any_hit,
                )  # fmt: skip
                if prim != previous:
                    u, v = a, b
            if any_hit and prim != first:
                break
        top, code, _ = pop(codes, keys, parents, top, 0, best * SLACK)
    return best, prim, u, v


@inner(inline="always")
def _search(first, last, memory, o, d, t_max, stride, words, t, prim, u, v, any_hit):
    """Search rays ``first <= i < last``, see :func:`nearest`; of any-hit rays ``prim`` is 1 or 0, and t, u, v are not used."""
    stack_length = item(words, 5)
    scratch, keys = part(memory, 0, np.float32), part(memory, INSTANCE_MEMORY, np.int32)
    work = (keys, part(keys, stack_length, np.int32), scratch)
    upper, lower = load_pointer(words, 0, np.float32), load_pointer(words, 1, np.float32)
    above = (upper, part(upper, 0, np.int32))
    below = (lower, part(lower, 0, np.int32), 0, 0, memory, 0)  # triangles, all opaque
    copies = (load_pointer(words, 2, np.float64), load_pointer(words, 3, np.int32), load_pointer(words, 4, np.int64))
    for i in range(first, last):
        p = (item(o, i), item(o, stride + i), item(o, 2 * stride + i))
        r = (item(d, i), item(d, stride + i), item(d, 2 * stride + i))
        reach, before = item(t_max, i), item(prim, i)
        if not is_valid_ray(p[0], p[1], p[2], r[0], r[1], r[2], reach):
            continue
        if any_hit:
            if before == 0:
                _, found, _, _ = _ray(p, r, reach, np.int32(-1), above, below, copies, work, True)
                put(prim, i, np.int32(1 if found >= 0 else 0))
        else:
            best, found, a, b = _ray(p, r, min(item(t, i), reach), before, above, below, copies, work, False)
            if found != before:
                put(prim, i, found)
                put(t, i, best)
                put(u, i, a)
                put(v, i, b)


@kernel("instances_nearest", INT, INT, BYTES, FLOATS, FLOATS, FLOATS, INT, LONGS, FLOATS, INTS, FLOATS, FLOATS)
def nearest(first, last, memory, o, d, t_max, stride, words, t, prim, u, v):
    """Update the hits of rays ``first <= i < last`` by nearer hits with instances.

    Args:
        first: first ray.
        last: ray after the last one.
        memory: scratch memory of :func:`torchpt.search.tree_layout.instance_memory`.
        o: origins ``(3, stride)``.
        d: directions ``(3, stride)``.
        t_max: ends of the rays.
        stride: length of a row of ``o`` and ``d``.
        words: the scene, see :func:`torchpt.search.tree_instances.instance_words`.
        t: nearest hits so far, inf for none; updated.
        prim: their primitives, -1 for none; updated.
        u: updated likewise.
        v: updated likewise.
    """
    _search(first, last, memory, o, d, t_max, stride, words, t, prim, u, v, False)


@kernel("instances_occluded", INT, INT, BYTES, FLOATS, FLOATS, FLOATS, INT, LONGS, INTS)
def occluded(first, last, memory, o, d, t_max, stride, words, out):
    """Write 1 to ``out`` for rays that hit an instance; rays that have 1 already are skipped. See :func:`nearest`."""
    _search(first, last, memory, o, d, t_max, stride, words, t_max, out, t_max, t_max, True)
