"""The search by the wide SAH tree: its topology, refitted where only vertices moved, and the search that takes rays."""

from __future__ import annotations

import copy
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.threads import thread_count
from torchpt.native.jit import ensure_compiled, jit, jit_internal, launch
from torchpt.native.simd import (
    bits,
    gather,
    highest,
    item,
    load,
    lowest,
    popcount,
    put,
    select,
    splat,
    store,
    trailing_zeros,
    widen,
)
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search import tree_packet as kernels
from torchpt.search.base import Accel, Array, Hits
from torchpt.search.bounds import select_primitives
from torchpt.search.tree_build import (
    Floats,
    NonTriangles,
    WideTree,
    aligned_buffer,
    boxes_of,
    corners,
    line_count,
    mesh_tree,
    planes_of,
    primitive_tables,
    stack_size,
    write_tree,
)
from torchpt.search.tree_layout import CHILDREN, IDS, LEAF, LINE, MORE, NODE, PLANES, block_offset
from torchpt.search.tree_leaf import RECTANGLES, RULED

__all__ = ["REBUILD_THRESHOLD", "RefitState", "WideBvh", "refit"]


# ---- A tree's blocks for primitives that have moved (numba): the same nodes, leaves and ids, with new boxes and triangles


_INF, _NAN = np.float32(np.inf), np.float32(np.nan)


@jit_internal(forceinline=True)
def _moved(tree, at, p, ids, here):
    """Corners of a leaf's triangles where the mask is set, NaN elsewhere: as they are written, in float64."""
    n, none = np.int32(p.shape[1]), splat(_NAN, 8)
    x = gather(p, ids, here, none)
    y = gather(p, ids + splat(n, 8), here, none)
    z = gather(p, ids + splat(np.int32(2 * n), 8), here, none)
    store(tree, at, x)
    store(tree, at + 8, y)
    store(tree, at + 16, z)
    return widen(x), widen(y), widen(z)


@jit_internal(forceinline=True)
def _half_area(tree, at):
    """Half the area of a box whose six numbers begin at ``at``, eight apart; 0 where it ends before it begins."""
    x = np.float64(item(tree, at + 24)) - np.float64(item(tree, at))
    y = np.float64(item(tree, at + 32)) - np.float64(item(tree, at + 8))
    z = np.float64(item(tree, at + 40)) - np.float64(item(tree, at + 16))
    return x * y + y * z + z * x if x >= 0.0 and y >= 0.0 and z >= 0.0 else 0.0


@jit_internal(forceinline=True)
def _union(boxes, first, out, at):
    """Writes the box about eight to ``at``; the numbers lie as in a node."""
    for j in range(0, 24, 8):
        put(out, at + j, lowest(load(boxes, first + j, 8)))
        put(out, at + 24 + j, highest(load(boxes, first + 24 + j, 8)))


@jit_internal()
def _leaf(at, old, tree, codes, p0, p1, p2, triangles, non_triangles, boxes):
    """Writes the block of a leaf; ``boxes`` ``(48,)`` gets low x, y, z, high x, y, z of what it holds."""
    ids, none = load(old, at + IDS, 8), splat(_NAN, 8)
    store(codes, at + IDS, ids)
    here = ids >= splat(np.int32(0), 8)
    a, b, c = (
        _moved(tree, at, p0, ids, here),
        _moved(tree, at + 24, p1, ids, here),
        _moved(tree, at + 48, p2, ids, here),
    )
    n0, n1, n2, d, good = planes_of(a, b, c)
    # A triangle that has no area is met by no ray; its id stays, as it may have one again.
    store(tree, at + PLANES, select(good, n0, none))
    store(tree, at + PLANES + 8, select(good, n1, none))
    store(tree, at + PLANES + 16, select(good, n2, none))
    store(tree, at + PLANES + 24, select(good, d, none))
    if bits(good) != bits(here):
        for j in range(0, 72, 8):
            store(tree, at + j, select(good, load(tree, at + j, 8), none))
    x0, y0, z0, x1, y1, z1 = boxes_of(a, b, c)
    low, high = splat(_INF, 8), splat(-_INF, 8)
    store(boxes, 0, select(good, x0, low))
    store(boxes, 8, select(good, y0, low))
    store(boxes, 16, select(good, z0, low))
    store(boxes, 24, select(good, x1, high))
    store(boxes, 32, select(good, y1, high))
    store(boxes, 40, select(good, z1, high))
    mixed = bits(ids < splat(np.int32(-1), 8))
    while mixed != 0:
        k = trailing_zeros(mixed)
        mixed &= mixed - 1
        for j in range(6):
            boxes[j * 8 + k] = non_triangles[-2 - item(old, at + IDS + k) - triangles, j]


@jit_internal()
def _rectangles(at, before, old, tree, corner, rows, triangles, disk):
    """Writes the rectangles of a leaf; the other places hold NaN, as before."""
    for j in range(RECTANGLES, RECTANGLES + MORE * LINE):
        put(tree, at + j, item(before, at + j))
    for k in range(8):
        q = -2 - item(old, at + IDS + k)
        if triangles <= q < disk:
            for c in range(12):
                put(tree, at + RECTANGLES + c * 8 + k, corner[q - triangles, c])
            for c in range(4):
                put(tree, at + RECTANGLES + RULED + c * 8 + k, rows[q - triangles, c])


@jit()
def refit(before, old, line, nodes, p0, p1, p2, triangles, disk, corner, rows, non_triangles, tree, codes):
    """Fills the blocks of a tree by the topology of another, which stays as it is.

    Children must lie behind their parents, and the leaves of a node right behind it.

    Args:
        before: the other tree's buffer, float32.
        old: the same memory as int32.
        line: the line of either buffer at which the root lies.
        nodes: how many nodes there are.
        p0: ``(3, P)`` float32 corners.
        p1: ``(3, P)``.
        p2: ``(3, P)``.
        triangles: how many of the P are triangles; these come first.
        disk: id of the first primitive that is neither triangle nor rectangle.
        corner: ``(P - triangles, 12)`` corners of the others.
        rows: ``(P - triangles, 12)`` their affine rows.
        non_triangles: ``(P - triangles, 6)`` float32 boxes of the others: low x, y, z, high x, y, z.
        tree: float32, as long as ``before``, filled.
        codes: the same memory as int32.

    Returns:
        Expected work of a random ray that meets the root's box, 1 a node and 1 a leaf: of the other tree, and of this one.
    """
    lines, boxes = np.empty(nodes, np.int64), np.empty(48, np.float32)
    first, root = np.int64(0), np.int64(line) * LINE
    for node in range(nodes):
        lines[node] = line
        children, none = load(old, line * LINE + CHILDREN, 8), splat(np.int32(0), 8)
        leaves = bits(children < none)
        ruled = leaves & bits((children & splat(np.int32(2), 8)) == none)
        line += NODE + LEAF * popcount(leaves) + MORE * popcount(ruled)
    work, work_before = 0.0, 0.0
    for node in range(nodes - 1, -1, -1):
        base = lines[node] * LINE
        store(codes, base + CHILDREN, load(old, base + CHILDREN, 16))
        for k in range(8):
            code, at = np.int64(item(old, base + CHILDREN + k)), base + k
            if code > 0:
                _union(tree, block_offset(code), tree, at)
            elif code < 0:
                _leaf(block_offset(code), old, tree, codes, p0, p1, p2, triangles, non_triangles, boxes)
                if code & 2 == 0:
                    _rectangles(block_offset(code), before, old, tree, corner, rows, triangles, disk)
                _union(boxes, first, tree, at)
            else:  # a box that ends before it begins is met by no ray
                for j in range(0, 24, 8):
                    put(tree, at + j, _INF)
                    put(tree, at + 24 + j, -_INF)
            work += _half_area(tree, at)
            work_before += _half_area(before, at)
    _union(tree, root, boxes, first)
    work /= _half_area(boxes, first)
    _union(before, root, boxes, first)
    return 1.0 + work_before / _half_area(boxes, first), 1.0 + work


# ---- What a tree in blocks keeps of how it was built, and the same tree for primitives that have moved


#: A tree is built anew where moves have made the expected work of a random ray more than this many times what it was when
#: the tree was built. Up to there searches took up to a quarter longer than in a tree built anew, mostly less than a tenth
#: (scripts/bench_refit.py): with 70,000 triangles, a build repays itself after some two million rays then.
REBUILD_THRESHOLD = 1.2


class RefitState:
    """Where a tree lies in its buffer, and what decides whether it can be refitted.

    Args:
        tree: as it was built.
        geometry: over which.
        line: the line of the buffer where its root lies.

    Attributes:
        sah_ratio: expected work of a random ray, as a multiple of what it was when the tree was built.
    """

    def __init__(self, tree: WideTree, geometry: Geometry, line: int = 0) -> None:
        self.nodes, self.line, self.counts = tree.nodes, line, geometry.counts
        self.without_area = np.zeros(0, np.int32)  # rising ids of what had no area
        if (tree.ids >= 0).sum() < geometry.size:
            self.without_area = np.setdiff1d(np.arange(geometry.size, dtype=np.int32), tree.ids)
        self.built_cost: float | None = None  # the work, which the first refit finds out
        self.sah_ratio = 1.0

    def refit(
        self, geometry: Geometry, non_triangles: NonTriangles, before: Floats, memory: Floats
    ) -> RefitState | None:
        """Fills this tree's part of ``memory`` by that of ``before``, for primitives that have moved.

        None where the counts are others, where a primitive that had no area when the tree was built has one now, where
        nothing has an area, and where the tree has become :data:`REBUILD_THRESHOLD` times as costly as it was; what ``memory`` holds
        then means nothing.
        """
        if geometry.counts != self.counts or self._gains_area(geometry):
            return None
        codes, triangles = before.view(np.int32), self.counts[0]
        corner, rows, _ = (x.numpy() for x in non_triangles.tensors)
        tables = (triangles, triangles + self.counts[1], corner, rows, non_triangles.boxes)
        args = (before, codes, self.line, self.nodes, *corners(geometry), *tables)
        work, moved = refit(*args, memory, memory.view(np.int32))
        found = copy.copy(self)
        found.built_cost = work if self.built_cost is None else self.built_cost
        found.sah_ratio = moved / found.built_cost
        return found if found.sah_ratio <= REBUILD_THRESHOLD else None  # NaN where nothing has an area

    def _gains_area(self, geometry: Geometry) -> bool:
        if not len(self.without_area):
            return False
        some = select_primitives(geometry, torch.from_numpy(self.without_area).long())
        _, _, ids, non_triangles = primitive_tables(some)
        return len(ids) > 0 or bool(non_triangles.area.any())


# ---- The CPU's tree: binned SAH, eight children a node, searched by vector kernels


_GRAIN = 512  # rays that repay another thread
_ALL_OPAQUE = np.empty(0, np.uint8)


class WideBvh(Accel):
    """SAH tree with eight children a node (numba, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.
    """

    name, refits = "numba", True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        self.threads = threads
        tree, planes, non_triangles = mesh_tree(geometry)
        self.counts, self.depth, self.sah_cost = geometry.counts, tree.depth, tree.cost
        self.nodes, self.leaves = tree.nodes, tree.leaves
        self.refit_state, self.copied = RefitState(tree, geometry), geometry.copies is not None
        memory = aligned_buffer(line_count(tree, geometry.counts) * LINE)
        write_tree(tree, geometry, planes, non_triangles, 0, memory)
        self._take(memory, non_triangles, start)

    def _take(self, memory: np.ndarray, non_triangles: NonTriangles, start: float) -> None:
        kinds = torch.tensor([*(sum(self.counts[:k]) for k in range(1, 5)), stack_size(self.depth)], dtype=torch.int64)
        self.tensors = [torch.from_numpy(memory), *non_triangles.tensors, kinds]
        self.arrays = _arrays(self.tensors)
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> WideBvh | None:
        """See :meth:`Accel.refit` and :meth:`RefitState.refit`; the new tree has memory of its own."""
        start = time.perf_counter()
        if (geometry.copies is not None) != self.copied:
            return None
        non_triangles, memory = NonTriangles(geometry), aligned_buffer(len(self.arrays[0]))
        refit_state = self.refit_state.refit(geometry, non_triangles, self.arrays[0], memory)
        if refit_state is None:
            return None
        tree = copy.copy(self)
        tree.threads, tree.refit_state = threads, refit_state
        tree._take(memory, non_triangles, start)
        return tree

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        t, u, v = (torch.empty_like(t_max) for _ in range(3))
        prim = torch.empty_like(t_max, dtype=torch.int32)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, *(x.numpy() for x in (t, prim, u, v)))
        launch(kernels.nearest, kernels.nearest_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return t, prim, u, v

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        out = torch.empty_like(t_max, dtype=torch.int32)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, _ALL_OPAQUE, out.numpy())
        launch(kernels.blocked, kernels.blocked_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return out != 0

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        args = (o, d, t_max, *self.arrays, t, prim, u, v)
        ensure_compiled(kernels.nearest, 0, 0, *args)(0, count, *args)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`."""
        args = (o, d, t_max, *self.arrays, _ALL_OPAQUE if non_opaque is None else non_opaque, out)
        ensure_compiled(kernels.blocked, 0, 0, *args)(0, count, *args)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`.

        The cost is what it was when the tree was built, times what the areas of its boxes have grown by since.
        """
        return {
            "name": self.name,
            "primitives": sum(self.counts),
            "nodes": self.nodes,
            "leaves": self.leaves,
            "sah_cost": self.sah_cost * self.refit_state.sah_ratio,
            "depth": self.depth,
            "bytes": sum(x.nbytes for x in self.tensors),
            "build_seconds": self.build_seconds,
        }


def _arrays(tensors: list[Tensor]) -> tuple[np.ndarray, ...]:
    """The kernels' arguments: the tree as float32 and as int32, then the others."""
    tree, *rest = (x.numpy() for x in tensors)
    return tree, tree.view(np.int32), *rest
