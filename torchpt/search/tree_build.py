"""Build an eight-wide BVH: a binary tree by the surface area heuristic, collapsed, then laid out in memory.

The work is done by kernels (``scripts/kernel_sources/tree_build.py``), on one thread; :func:`mesh_tree` and :func:`write_tree`
are what the searches call.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.native.kernels import kernel
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.bounds import primitive_bounds
from torchpt.search.tables import QUADRIC, affine_rows, quadric_rows
from torchpt.search.tree_layout import LEAF, LINE, MORE, NODE, WIDTH

__all__ = [
    "Floats",
    "NonTriangles",
    "WideTree",
    "aligned_buffer",
    "build_binary",
    "corners",
    "line_count",
    "mesh_tree",
    "primitive_tables",
    "wide_tree",
    "write_tree",
]

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]


class WideTree:
    """A wide tree before its memory layout.

    Attributes:
        boxes: ``(M * 48,)``: low x, y, z, high x, y, z of eight children a node; infinite for none.
        child: ``(M * 8,)``: a node, or ``~leaf``, or 0 for none.
        ids: ``(L * 8,)``: primitives of the leaves in rising order, -1 for none.
        depth: nodes on the longest path from the root.
        cost: expected cost of a random ray through the root's box, 1 a node.
    """

    def __init__(self, boxes: Floats, child: Ints, ids: Ints, depth: int, cost: float) -> None:
        self.boxes, self.child, self.ids, self.depth, self.cost = boxes, child, ids, depth, cost

    @property
    def nodes(self) -> int:
        """Return the number of nodes."""
        return len(self.child) // WIDTH

    @property
    def leaves(self) -> int:
        """Return the number of leaves."""
        return len(self.ids) // WIDTH


class NonTriangles:
    """The K primitives of a geometry that are not triangles.

    Attributes:
        area: ``(K,)`` bool: True if the primitive can be hit.
        boxes: ``(K, 6)`` float32: low x, y, z, high x, y, z; an empty box if the primitive cannot be hit.
        tensors: tables for the search: corners ``(K, 12)`` float32, affine rows ``(K, 12)`` float32 and quadrics ``(Q, 19)``
            float64; NaN if a primitive cannot be hit.
    """

    def __init__(self, geometry: Geometry) -> None:
        rest = _without_triangles(geometry)
        if not rest.size:  # the operations below take longer than the build for a small mesh
            self.area, self.boxes = np.zeros(0, bool), np.zeros((0, 6), np.float32)
            self.tensors = [torch.zeros(0, 12), torch.zeros(0, 12), torch.zeros(0, QUADRIC, dtype=torch.float64)]
            return
        tables = affine_rows(rest)
        good = tables.area
        low, high = primitive_bounds(rest)
        boxes = torch.cat((torch.where(good, low, torch.inf), torch.where(good, high, -torch.inf)))
        self.area, self.boxes = good.numpy(), boxes.T.contiguous().numpy()
        corner = torch.cat([rest.p0, rest.p1, rest.p2, (rest.p1 + rest.p2) - rest.p0]).float()
        corner, quadrics = torch.where(good, corner, torch.nan), quadric_rows(rest)
        quadrics = torch.where(good[rest.size - rest.counts[4] :], quadrics, torch.nan)
        self.tensors = [corner.T.contiguous(), tables.rows, quadrics.T.contiguous()]


def build_binary(boxes: Floats, ids: Ints, common: int) -> tuple[Floats, Ints]:
    """Build a binary tree over boxes ``(L, 6)`` of primitives ``ids (L,)``; both arrays are permuted.

    A leaf holds at most :data:`~torchpt.search.tree_layout.WIDTH` primitives. Primitives are split down to one a leaf if their
    ids are not below ``common`` (only primitives of one kind are tested together), or if their areas sum to less than the area
    of their bounding box.

    Returns:
        Boxes ``(M, 6)`` of the nodes, the root first; and ``(M, 3)``: first primitive, one past the last, first child (0 for a
        leaf; the second child follows it).
    """
    nodes, spans = np.empty((2 * len(ids), 6), np.float32), np.empty((2 * len(ids), 3), np.int32)
    used = kernel("tree_build", "build_binary")(boxes, ids, nodes, spans, common)
    return nodes[:used], spans[:used]


def wide_tree(boxes: Floats, ids: Ints, counts: tuple[int, ...] = (0, 0)) -> WideTree:
    """Build a wide tree over boxes ``(L, 6)`` of primitives ``ids (L,)``; both arrays are permuted.

    ``counts`` begins with the numbers of triangles and of rectangles, whose ids come first in this order.
    """
    n = len(ids)
    if n == 0:
        return WideTree(
            np.full(6 * WIDTH, np.inf, np.float32), np.zeros(WIDTH, np.int32), np.zeros(0, np.int32), 1, 0.0
        )
    nodes, spans = build_binary(boxes, ids, counts[0])
    used = len(nodes)
    cost, share = np.empty((used, WIDTH), np.float32), np.empty((used, WIDTH), np.int8)
    kernel("tree_build", "choose_collapse")(nodes, spans, ids, counts[0], counts[0] + counts[1], cost, share)
    wide, ends = max(1, int((share[:, 0] > 0).sum())), int((share[:, 0] == 0).sum())
    flat, child = np.empty(wide * 6 * WIDTH, np.float32), np.empty(wide * WIDTH, np.int32)
    first, pending, found = np.empty((ends, 2), np.int32), np.empty((wide + 1, 2), np.int32), np.empty(3, np.int32)
    kernel("tree_build", "collapse")(nodes, spans, share, flat, child, first, pending, found)
    count, leaves, depth = found.tolist()
    slots = np.empty((leaves, WIDTH), np.int32)
    kernel("tree_build", "leaf_ids")(first[:leaves], ids, slots)
    x, y, z = (nodes[0, 3:] - nodes[0, :3]).astype(np.float64)
    area = x * y + y * z + z * x
    # Expected cost of a random ray through the root's box (MacDonald & Booth 1990).
    expected = float(cost[0, 0] / area) if area > 0 else float(n)
    return WideTree(flat[: count * 6 * WIDTH], child[: count * WIDTH], slots.reshape(-1), depth, expected)


def line_count(tree: WideTree, counts: tuple[int, ...]) -> int:
    """Return the size of a tree in cache lines; ``counts`` are the numbers of primitives of each kind."""
    ids = tree.ids.reshape(-1, WIDTH)
    ruled = ((ids >= counts[0]) & (ids < counts[0] + counts[1])).any(1).sum() if counts[1] else 0
    return NODE * tree.nodes + LEAF * tree.leaves + MORE * int(ruled)


def aligned_buffer(count: int) -> Floats:
    """Allocate ``count`` float32, aligned to a cache line."""
    raw = np.zeros(count * 4 + LINE * 4, np.uint8)
    skip = -raw.ctypes.data % (LINE * 4)
    return raw[skip : skip + count * 4].view(np.float32)


def primitive_tables(geometry: Geometry) -> tuple[Floats, Floats, Ints, NonTriangles]:
    """Return planes ``(T, 4)`` of the triangles, boxes ``(K, 6)`` and ids ``(K,)`` of those with an area, and the others."""
    count = geometry.counts[0]
    planes, boxes, ids = np.empty((count, 4), np.float32), np.empty((count, 6), np.float32), np.empty(count, np.int32)
    kept = kernel("tree_build", "triangle_tables")(*corners(geometry), count, planes, boxes, ids)
    return planes, boxes[:kept], ids[:kept], NonTriangles(geometry)


def mesh_tree(geometry: Geometry) -> tuple[WideTree, Floats, NonTriangles]:
    """Build the tree of a geometry; return it with the planes ``(T, 4)`` of its triangles and its other primitives."""
    planes, boxes, ids, non_triangles = primitive_tables(geometry)
    if non_triangles.area.size:
        keep = np.flatnonzero(non_triangles.area)
        boxes = np.concatenate([boxes, non_triangles.boxes[keep]])
        ids = np.concatenate([ids, (keep + geometry.counts[0]).astype(np.int32)])
    return wide_tree(boxes, ids, geometry.counts), planes, non_triangles


def write_tree(
    tree: WideTree, geometry: Geometry, planes: Floats, non_triangles: NonTriangles, line: int, memory: Floats
) -> None:
    """Write a tree to ``memory`` from a line on."""
    codes, triangles = memory.view(np.int32), geometry.counts[0]
    disk = triangles + geometry.counts[1]
    tables = (planes, non_triangles.tensors[0].numpy(), non_triangles.tensors[1].numpy())
    topology, scratch = (tree.boxes, tree.child, tree.ids), np.empty(tree.nodes, np.int64)
    stack = np.empty(len(tree.child) + WIDTH, np.int32)
    kernel("tree_build", "lay_out")(
        *topology, *corners(geometry), *tables, triangles, disk, line, memory, codes, scratch, stack
    )


def corners(geometry: Geometry) -> tuple[Floats, Floats, Floats]:
    """Return the three corners ``(3, P)`` as arrays."""
    return tuple(p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))  # type: ignore[return-value]


def _without_triangles(geometry: Geometry) -> Geometry:
    _, *counts = geometry.counts
    p0, p1, p2 = (p[:, geometry.counts[0] :] for p in (geometry.p0, geometry.p1, geometry.p2))
    return Geometry(p0, p1, p2, (0, counts[0], counts[1], counts[2], counts[3]), geometry.quadrics)
