"""Trees for the CPU's search: binary over boxes, then of eight children a node, then blocks of cache lines."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.accel.bounds import primitive_bounds
from torchpt.accel.kernels_blocks import LEAF, LINE, MORE, NODE
from torchpt.accel.kernels_build import WIDTH, build_binary
from torchpt.accel.kernels_collapse import choose, collapse
from torchpt.accel.kernels_layout import lay_out
from torchpt.accel.kernels_tables import leaf_ids, triangle_tables
from torchpt.accel.tables import QUADRIC, inverses, prepare
from torchpt.records import Geometry

__all__ = [
    "Others",
    "Tree",
    "aligned",
    "corners",
    "lines_of",
    "mesh_tree",
    "room_of",
    "tables_of",
    "wide_tree",
    "write",
]

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class Tree:
    """A tree of boxes, before it is laid out.

    Attributes:
        boxes: ``(M * 48,)``: low x, y, z, high x, y, z of eight children a node; infinite where there is none.
        child: ``(M * 8,)``: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)``: what the leaves hold, in rising order, -1 where there is nothing.
        depth: nodes on the longest way down.
        cost: expected work of a ray, 1 a node; see :mod:`torchpt.accel.kernels_collapse`.
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


class Others:
    """The K primitives of a geometry that are no triangles.

    Attributes:
        area: ``(K,)`` bool: the primitive can be hit.
        boxes: ``(K, 6)`` float32: low x, y, z, high x, y, z; a box that ends before it begins where it cannot be hit.
        tensors: what the search's kernels take of them: corners ``(K, 12)`` float32, affine rows ``(K, 12)`` float32 and
            quadrics ``(Q, 19)`` float64; NaN, which no ray meets, where a primitive cannot be hit.
    """

    def __init__(self, geometry: Geometry) -> None:
        rest = _without_triangles(geometry)
        if not rest.size:  # the operations below would take longer than the tree of a small mesh
            self.area, self.boxes = np.zeros(0, bool), np.zeros((0, 6), np.float32)
            self.tensors = [torch.zeros(0, 12), torch.zeros(0, 12), torch.zeros(0, QUADRIC, dtype=torch.float64)]
            return
        tables = prepare(rest)
        good = tables.area
        low, high = primitive_bounds(rest)
        boxes = torch.cat((torch.where(good, low, torch.inf), torch.where(good, high, -torch.inf)))
        self.area, self.boxes = good.numpy(), boxes.T.contiguous().numpy()
        corner = torch.cat([rest.p0, rest.p1, rest.p2, (rest.p1 + rest.p2) - rest.p0]).float()
        corner, quadrics = torch.where(good, corner, torch.nan), inverses(rest)
        quadrics = torch.where(good[rest.size - rest.counts[4] :], quadrics, torch.nan)
        self.tensors = [corner.T.contiguous(), tables.rows, quadrics.T.contiguous()]


def wide_tree(boxes: Floats, ids: Ints, counts: tuple[int, ...] = (0, 0)) -> Tree:
    """Builds over boxes ``(L, 6)`` of ``ids (L,)``; both are permuted.

    ``counts`` says how many triangles there are and how many rectangles, whose ids come first in this order.
    """
    n = len(ids)
    if n == 0:
        return Tree(np.full(6 * WIDTH, np.inf, np.float32), np.zeros(WIDTH, np.int32), np.zeros(0, np.int32), 1, 0.0)
    nodes, spans = np.empty((2 * n, 6), np.float32), np.empty((2 * n, 3), np.int32)
    used = build_binary(boxes, ids, nodes, spans, counts[0])
    nodes, spans = nodes[:used], spans[:used]
    cost, share = np.empty((used, WIDTH), np.float32), np.empty((used, WIDTH), np.int8)
    choose(nodes, spans, ids, counts[0], counts[0] + counts[1], cost, share)
    wide, ends = max(1, int((share[:, 0] > 0).sum())), int((share[:, 0] == 0).sum())
    flat, child = np.empty(wide * 6 * WIDTH, np.float32), np.empty(wide * WIDTH, np.int32)
    first = np.empty((ends, 2), np.int32)
    count, leaves, depth = collapse(nodes, spans, share, flat, child, first)
    slots = np.empty((leaves, WIDTH), np.int32)
    leaf_ids(first[:leaves], ids, slots)
    x, y, z = (nodes[0, 3:] - nodes[0, :3]).astype(np.float64)
    area = x * y + y * z + z * x
    # Expected cost of a random ray through the root's box (MacDonald & Booth 1990).
    expected = float(cost[0, 0] / area) if area > 0 else float(n)
    return Tree(flat[: count * 6 * WIDTH], child[: count * WIDTH], slots.reshape(-1), depth, expected)


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


def tables_of(geometry: Geometry) -> tuple[Floats, Floats, Ints, Others]:
    """Planes ``(T, 4)`` of the triangles, boxes ``(K, 6)`` and rising ids ``(K,)`` of those with an area, and the others."""
    count = geometry.counts[0]
    planes, boxes, ids = np.empty((count, 4), np.float32), np.empty((count, 6), np.float32), np.empty(count, np.int32)
    kept = triangle_tables(*corners(geometry), count, planes, boxes, ids)
    return planes, boxes[:kept], ids[:kept], Others(geometry)


def mesh_tree(geometry: Geometry) -> tuple[Tree, Floats, Others]:
    """The tree over a geometry's primitives, the planes ``(T, 4)`` of its triangles, and what there is of others."""
    planes, boxes, ids, others = tables_of(geometry)
    if others.area.size:
        keep = np.flatnonzero(others.area)
        boxes = np.concatenate([boxes, others.boxes[keep]])
        ids = np.concatenate([ids, (keep + geometry.counts[0]).astype(np.int32)])
    return wide_tree(boxes, ids, geometry.counts), planes, others


def write(tree: Tree, geometry: Geometry, planes: Floats, others: Others, line: int, memory: Floats) -> None:
    """Lays a tree out in ``memory`` from a line on."""
    codes, triangles = memory.view(np.int32), geometry.counts[0]
    disk = triangles + geometry.counts[1]
    tables = (planes, others.tensors[0].numpy(), others.tensors[1].numpy())
    lay_out(tree.boxes, tree.child, tree.ids, *corners(geometry), *tables, triangles, disk, line, memory, codes)


def corners(geometry: Geometry) -> tuple[Floats, Floats, Floats]:
    """The three corners ``(3, P)`` as arrays."""
    return tuple(p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))  # type: ignore[return-value]


def _without_triangles(geometry: Geometry) -> Geometry:
    _, *counts = geometry.counts
    p0, p1, p2 = (p[:, geometry.counts[0] :] for p in (geometry.p0, geometry.p1, geometry.p2))
    return Geometry(p0, p1, p2, (0, counts[0], counts[1], counts[2], counts[3]), geometry.quadrics)
