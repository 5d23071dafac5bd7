"""Copies of meshes as a second level, by vectors (numba): a tree over their boxes above the trees of their meshes."""

from __future__ import annotations

import time
from copy import copy as shallow
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from torchpt.core.threads import thread_count
from torchpt.native.jit import ensure_compiled, jit, jit_internal, launch
from torchpt.native.simd import item, pointer, put, splat
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Array, Hits, mark_non_opaque
from torchpt.search.instances import CopyTables
from torchpt.search.tree import RefitState, WideBvh
from torchpt.search.tree_build import (
    NonTriangles,
    WideTree,
    aligned_buffer,
    line_count,
    mesh_tree,
    stack_size,
    wide_tree,
    write_tree,
)
from torchpt.search.tree_layout import IDS, LINE, SLACK, block_offset, boxes, is_valid_ray, push
from torchpt.search.tree_leaf import setup_ray
from torchpt.search.tree_packet import PIECES
from torchpt.search.tree_single import SCRATCH, pop, trace_single

__all__ = ["InstancedWideBvh", "blocked", "blocked_parallel", "nearest", "nearest_parallel"]


# ---- Copies of meshes (numba): a tree over their boxes, and for each that is met the tree of its mesh


_ZERO, _INF = np.float32(0.0), np.float32(np.inf)


@jit_internal(forceinline=True)
def _row(table, k, x, y, z):
    """Three float64 numbers of an affine map's row with a point, without its last number."""
    return item(table, k) * x + item(table, k + 1) * y + item(table, k + 2) * z


@jit_internal()
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


@jit_internal()
def _ray(o, d, best, prim, upper, lower, copies, work, any_hit):
    """The nearest hit of one ray among the copies where it is nearer than ``best``, or any such hit: ``t, prim, u, v``."""
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


@jit_internal(inline="always")
def _search(
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
    stack_length,
    t,
    prim,
    u,
    v,
    any_hit,
):
    keys, parents, scratch = (
        np.empty(stack_length, np.int32),
        np.empty(stack_length, np.int32),
        np.empty(SCRATCH, np.float32),
    )
    none = np.empty(1, np.uint8)
    work = (pointer(keys), pointer(parents), pointer(scratch))
    above, below = (
        (pointer(upper), pointer(upper_codes)),
        (pointer(lower), pointer(lower_codes), 0, 0, pointer(none), 0),
    )
    copies = (pointer(table), pointer(shift), pointer(roots))
    for i in range(first, last):
        p, r = (o[0, i], o[1, i], o[2, i]), (d[0, i], d[1, i], d[2, i])
        if not is_valid_ray(p[0], p[1], p[2], r[0], r[1], r[2], t_max[i]):
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
def nearest(
    first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length, t, prim, u, v
):
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
        stack_length: entries of the stack.
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
        stack_length,
        t,
        prim,
        u,
        v,
        False,
    )


@jit(parallel=True)
def nearest_parallel(
    chunks, items, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length, t, prim, u, v
):
    """:func:`nearest` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            nearest(
                a,
                b,
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
                stack_length,
                t,
                prim,
                u,
                v,
            )


@jit()
def blocked(first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length, out):
    """Puts 1 in ``out (N,)`` for rays that hit a copy; those that have it already are left alone."""
    _search(
        first, last, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length,
        t_max, out, t_max, t_max, True,
    )  # fmt: skip


@jit(parallel=True)
def blocked_parallel(
    chunks, items, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length, out
):
    """:func:`blocked` over the rays in equal pieces, which the threads take in turn."""
    pieces = chunks * PIECES
    for c in prange(chunks):
        for k in range(c, pieces, chunks):
            a, b = k * items // pieces, (k + 1) * items // pieces
            blocked(a, b, o, d, t_max, upper, upper_codes, lower, lower_codes, table, shift, roots, stack_length, out)


# ---- Copies on the CPU: a tree over their boxes above the trees of their meshes (numba)


_GRAIN = 256  # rays that repay another thread


class InstancedWideBvh(Accel):
    """The primitives in one wide tree, and two levels of them for the copies.

    Args:
        geometry: with copies, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.
    """

    name, refits = "numba", True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        tables = CopyTables(geometry)
        trees, self.refit_states, lower = _meshes(tables.meshes)
        self._below = [sum(x.nodes for x in trees), sum(x.leaves for x in trees), max(x.depth for x in trees)]
        self._take(geometry, WideBvh(geometry, threads), tables, lower, start)

    def _take(self, geometry: Geometry, base: WideBvh, tables: CopyTables, lower: np.ndarray, start: float) -> None:
        """Builds the upper level."""
        assert geometry.copies is not None
        self.base, self.threads, self.places = base, base.threads, geometry.copies[12:]
        some = np.flatnonzero([tables.meshes[k].size > 0 for k in tables.mesh.tolist()]).astype(np.int32)
        boxes = torch.cat((tables.low, tables.high)).T.contiguous().numpy()[some]
        top = wide_tree(boxes, some.copy())
        none = _nothing()
        upper = aligned_buffer(line_count(top, none.counts) * LINE)
        write_tree(top, none, np.zeros((0, 4), np.float32), NonTriangles(none), 0, upper)
        nodes, leaves, depth = self._below
        depth += top.depth
        roots = np.array([4 * x.line for x in self.refit_states], np.int64)
        self.arrays = (
            upper, upper.view(np.int32), lower, lower.view(np.int32), tables.inverse.numpy(),
            tables.shift.numpy().astype(np.int32), roots[tables.mesh.numpy()], stack_size(depth),
        )  # fmt: skip
        self.depth, self.copies, self.nodes, self.leaves = depth, len(some), top.nodes + nodes, top.leaves + leaves
        self.ids = int(geometry.size + geometry.copies[13].sum())
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> InstancedWideBvh | None:
        """See :meth:`Accel.refit`; the upper level, of a few boxes beside the primitives', is always built anew."""
        start = time.perf_counter()
        if geometry.copies is None or not torch.equal(geometry.copies[12:], self.places):
            return None
        base = self.base.refit(geometry, threads)
        if base is None:
            return None
        tables, before, found = CopyTables(geometry), self.arrays[2], []
        lower = aligned_buffer(len(before))
        for refit_state, mesh in zip(self.refit_states, tables.meshes, strict=True):
            # no copy of an empty mesh is in the upper level
            moved = refit_state if not mesh.size else refit_state.refit(mesh, NonTriangles(mesh), before, lower)
            if moved is None:
                return None
            found.append(moved)
        tree = shallow(self)
        tree.refit_states = found
        tree._take(geometry, base, tables, lower, start)
        return tree

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        hits = self.base._intersect(o, d, t_max)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, *(x.numpy() for x in hits))
        launch(nearest, nearest_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return hits

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        out = self.base._occluded(o, d, t_max).int()
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, out.numpy())
        launch(blocked, blocked_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return out != 0

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        self.base.nearest(o, d, t_max, count, t, prim, u, v)
        args = (o, d, t_max, *self.arrays, t, prim, u, v)
        ensure_compiled(nearest, 0, 0, *args)(0, count, *args)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`; where there are non_opaque, every ray that meets anything is to be looked at closer."""
        self.base.blocked(o, d, t_max, count, out)
        args = (o, d, t_max, *self.arrays, out)
        ensure_compiled(blocked, 0, 0, *args)(0, count, *args)
        mark_non_opaque(out[:count], non_opaque)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; nodes, leaves and bytes count each mesh once, the cost is that of what is no copy."""
        base = self.base.describe()
        upper, _, lower, _, *tables = self.arrays[:-1]
        return base | {
            "primitives": self.ids,
            "instances": self.copies,
            "nodes": base["nodes"] + self.nodes,
            "leaves": base["leaves"] + self.leaves,
            "bytes": base["bytes"] + sum(x.nbytes for x in (upper, lower, *tables)),
            "depth": max(base["depth"], self.depth),
            "build_seconds": self.build_seconds,
        }


def _nothing() -> Geometry:
    """No primitive: what leaves of copies have for triangles."""
    none = torch.zeros(3, 0)
    return Geometry(none, none, none, (0, 0, 0, 0, 0))


def _meshes(meshes: list[Geometry]) -> tuple[list[WideTree], list[RefitState], np.ndarray]:
    """The trees of all meshes, where they lie, and their blocks one after the other."""
    built = [mesh_tree(mesh) for mesh in meshes]
    lines = [line_count(tree, mesh.counts) for (tree, _, _), mesh in zip(built, meshes, strict=True)]
    lines = np.cumsum([0, *lines]).tolist()
    memory = aligned_buffer(lines[-1] * LINE)
    for (tree, planes, non_triangles), mesh, line in zip(built, meshes, lines[:-1], strict=True):
        write_tree(tree, mesh, planes, non_triangles, line, memory)
    trees = [tree for tree, _, _ in built]
    return trees, [RefitState(*args) for args in zip(trees, meshes, lines[:-1], strict=True)], memory
