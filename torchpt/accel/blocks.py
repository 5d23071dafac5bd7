"""Trees for the CPU's search: binned SAH over boxes, eight children a node, then blocks of cache lines."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.accel.bounds import primitive_bounds
from torchpt.accel.kernels_blocks import LEAF, LINE, NODE
from torchpt.accel.kernels_build import WIDTH, build_binary, collapse
from torchpt.accel.kernels_layout import lay_out
from torchpt.accel.tables import prepare
from torchpt.records import Geometry

__all__ = ["Tree", "aligned", "lines_of", "mesh_tree", "room_of", "wide_tree", "write"]

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
    first = first[:leaves]
    place = first[:, :1] + np.arange(WIDTH)
    none = np.iinfo(np.int32).max
    slots = np.where(place < first[:, 1:], ids[np.minimum(place, n - 1)], none)
    slots.sort(axis=1)
    slots[slots == none] = -1
    cost = _binary_cost(nodes[:used], spans[:used])
    return Tree(flat[: count * 6 * WIDTH], child[: count * WIDTH], slots.reshape(-1), depth, cost)


def _binary_cost(nodes: Floats, spans: Ints) -> float:
    """Expected cost of a random ray through the root's box: 1 a node, 1 a primitive (MacDonald & Booth 1990)."""
    size = nodes[:, 3:].astype(np.float64) - nodes[:, :3]
    area = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
    work = np.where(spans[:, 2] > 0, 1, spans[:, 1] - spans[:, 0])
    return float((area * work).sum() / area[0]) if area[0] > 0 else float(work[0])


def lines_of(tree: Tree) -> int:
    """Cache lines that a tree takes."""
    return NODE * tree.nodes + LEAF * tree.leaves


def room_of(depth: int) -> int:
    """Entries of a stack for trees of that depth: seven a level stay, and eight are written at once."""
    return depth * (WIDTH - 1) + 2 * WIDTH


def aligned(count: int) -> Floats:
    """Memory for ``count`` float32 that begins with a cache line."""
    raw = np.zeros(count * 4 + LINE * 4, np.uint8)
    skip = -raw.ctypes.data % (LINE * 4)
    return raw[skip : skip + count * 4].view(np.float32)


def mesh_tree(geometry: Geometry) -> tuple[Tree, Floats]:
    """The tree over a geometry's primitives, and the affine rows ``(P, 12)`` of all."""
    tables = prepare(geometry)
    keep = torch.nonzero(tables.area)[:, 0]
    boxes = torch.cat(primitive_bounds(geometry)).T[keep].contiguous().numpy()
    return wide_tree(boxes, keep.int().numpy()), tables.rows.numpy()


def write(tree: Tree, geometry: Geometry, rows: Floats, line: int, memory: Floats) -> None:
    """Lays a tree out in ``memory`` from a line on."""
    corners = (p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))
    lay_out(tree.boxes, tree.child, tree.ids, *corners, rows, geometry.counts[0], line, memory, memory.view(np.int32))
