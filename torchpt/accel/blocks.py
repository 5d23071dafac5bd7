"""Trees for the CPU's search: binned SAH over boxes, eight children a node, then blocks of cache lines."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.accel.bounds import primitive_bounds
from torchpt.accel.kernels_blocks import LEAF, LINE, MORE, NODE
from torchpt.accel.kernels_build import WIDTH, build_binary, collapse
from torchpt.accel.kernels_layout import lay_out
from torchpt.accel.kernels_tables import leaf_ids, triangle_tables, work
from torchpt.accel.tables import prepare
from torchpt.records import Geometry

__all__ = ["Tree", "aligned", "corners_of", "lines_of", "mesh_tree", "room_of", "wide_tree", "write"]

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class Tree:
    """A tree of boxes, before it is laid out.

    Attributes:
        boxes: ``(M * 48,)``: low x, y, z, high x, y, z of eight children a node; infinite where there is none.
        child: ``(M * 8,)``: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)``: what the leaves hold, in rising order, -1 where there is nothing.
        depth: nodes on the longest way down.
        cost: expected work of a ray, 1 a node and 1 a primitive.
    """

    def __init__(self, boxes: Floats, child: Ints, ids: Ints, depth: int, cost: float) -> None:
        self.boxes, self.child, self.ids, self.depth, self.cost = boxes, child, ids, depth, cost

    @property
    def nodes(self) -> int:
        """How many nodes there are."""
        return len(self.child) // WIDTH

    @property
    def leaves(self) -> int:
        """How many leaves there are."""
        return len(self.ids) // WIDTH


def wide_tree(boxes: Floats, ids: Ints) -> Tree:
    """Builds over boxes ``(L, 6)`` of ``ids (L,)``; both are permuted."""
    n = len(ids)
    if n == 0:
        return Tree(np.full(6 * WIDTH, np.inf, np.float32), np.zeros(WIDTH, np.int32), np.zeros(0, np.int32), 1, 0.0)
    nodes, spans = np.empty((2 * n, 6), np.float32), np.empty((2 * n, 3), np.int32)
    used = build_binary(boxes, ids, nodes, spans, WIDTH)
    wide = max(1, int((spans[:used, 2] > 0).sum()))
    flat, child = np.empty(wide * 6 * WIDTH, np.float32), np.empty(wide * WIDTH, np.int32)
    first = np.empty((used, 2), np.int32)
    count, leaves, depth = collapse(nodes, spans, flat, child, first)
    slots = np.empty((leaves, WIDTH), np.int32)
    leaf_ids(first[:leaves], ids, slots)
    x, y, z = (nodes[0, 3:] - nodes[0, :3]).astype(np.float64)
    area = x * y + y * z + z * x
    # Expected cost of a random ray through the root's box (MacDonald & Booth 1990).
    cost = work(nodes[:used], spans[:used]) / area if area > 0 else float(n)
    return Tree(flat[: count * 6 * WIDTH], child[: count * WIDTH], slots.reshape(-1), depth, float(cost))


def lines_of(tree: Tree, counts: tuple[int, ...]) -> int:
    """Cache lines that a tree takes over primitives of which there are ``counts`` of each kind."""
    ids = tree.ids.reshape(-1, WIDTH)
    ruled = ((ids >= counts[0]) & (ids < counts[0] + counts[1])).any(1).sum() if counts[1] else 0
    return NODE * tree.nodes + LEAF * tree.leaves + MORE * int(ruled)


def room_of(depth: int) -> int:
    """Entries of a stack for trees of that depth: seven a level stay, and eight are written at once."""
    return depth * (WIDTH - 1) + 2 * WIDTH


def aligned(count: int) -> Floats:
    """Memory for ``count`` float32 that begins with a cache line."""
    raw = np.zeros(count * 4 + LINE * 4, np.uint8)
    skip = -raw.ctypes.data % (LINE * 4)
    return raw[skip : skip + count * 4].view(np.float32)


def mesh_tree(geometry: Geometry) -> tuple[Tree, Floats, Floats]:
    """The tree over a geometry's primitives, the planes ``(T, 4)`` of its triangles, the affine rows ``(K, 12)`` of others."""
    count = geometry.counts[0]
    planes, boxes, ids = np.empty((count, 4), np.float32), np.empty((count, 6), np.float32), np.empty(count, np.int32)
    kept = triangle_tables(*_corners(geometry), count, planes, boxes, ids)
    boxes, ids = boxes[:kept], ids[:kept]
    rest = _without_triangles(geometry)
    tables = prepare(rest)
    if rest.size:
        keep = torch.nonzero(tables.area)[:, 0]
        more = torch.cat(primitive_bounds(rest)).T[keep].numpy()
        boxes, ids = np.concatenate([boxes, more]), np.concatenate([ids, keep.int().numpy() + np.int32(count)])
    return wide_tree(boxes, ids), planes, tables.rows.numpy()


def write(tree: Tree, geometry: Geometry, planes: Floats, rows: Floats, line: int, memory: Floats) -> None:
    """Lays a tree out in ``memory`` from a line on."""
    codes, triangles = memory.view(np.int32), geometry.counts[0]
    disk = triangles + geometry.counts[1]
    tables = (planes, corners_of(geometry), rows)
    lay_out(tree.boxes, tree.child, tree.ids, *_corners(geometry), *tables, triangles, disk, line, memory, codes)


def corners_of(geometry: Geometry) -> Floats:
    """Corners of the primitives that are no triangles, and fourth corners ``(K, 12)``."""
    p0, p1, p2 = (p[:, geometry.counts[0] :] for p in (geometry.p0, geometry.p1, geometry.p2))
    return torch.cat([p0, p1, p2, (p1 + p2) - p0]).float().T.contiguous().numpy()


def _without_triangles(geometry: Geometry) -> Geometry:
    _, *counts = geometry.counts
    p0, p1, p2 = (p[:, geometry.counts[0] :] for p in (geometry.p0, geometry.p1, geometry.p2))
    return Geometry(p0, p1, p2, (0, counts[0], counts[1], counts[2], counts[3]), geometry.quadrics)


def _corners(geometry: Geometry) -> tuple[Floats, Floats, Floats]:
    return tuple(p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))  # type: ignore[return-value]
