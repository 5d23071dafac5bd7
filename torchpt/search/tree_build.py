"""Build a wide tree, a BVH with eight children a node: a binary tree by the surface area heuristic, collapsed, then laid out.

Kernels do the work (``scripts/kernel_sources/tree_build.py``), on one thread. The searches call :func:`mesh_tree`, which
builds, and :func:`write_tree`, which writes the tree to memory (:mod:`torchpt.search.tree_layout`).

In shapes P is the number of all primitives, T of triangles, K of the other primitives, L of the primitives with an area (or of
leaves of a wide tree), M of nodes.
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
        boxes: ``(M * 48,)``: for each node low x of its eight children, then low y, z, high x, y, z; infinite for no child.
        child: ``(M * 8,)``: the index of a child that is a node, ``~k`` for leaf k, 0 for no child (0 is the root).
        ids: ``(L * 8,)``: primitive ids of each leaf in ascending order, then -1.
        depth: nodes on the longest path from the root.
        cost: expected cost of a random ray through the root's box, in units of a visit of a node.
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
        if not rest.size:  # to save time: the operations below take longer than the build of a small mesh
            self.area, self.boxes = np.zeros(0, bool), np.zeros((0, 6), np.float32)
            self.tensors = [
                torch.zeros(0, 12, dtype=torch.float32),
                torch.zeros(0, 12, dtype=torch.float32),
                torch.zeros(0, QUADRIC, dtype=torch.float64),
            ]
            return
        tables = affine_rows(rest)
        area = tables.area
        low, high = primitive_bounds(rest)
        boxes = torch.cat((torch.where(area, low, torch.inf), torch.where(area, high, -torch.inf)))
        self.area, self.boxes = area.numpy(), boxes.T.contiguous().numpy()
        corner = torch.cat([rest.p0, rest.p1, rest.p2, (rest.p1 + rest.p2) - rest.p0]).float()
        corner, quadrics = torch.where(area, corner, torch.nan), quadric_rows(rest)
        quadrics = torch.where(
            area[rest.size - quadrics.shape[1] :], quadrics, torch.nan
        )  # they are the last primitives
        self.tensors = [corner.T.contiguous(), tables.rows, quadrics.T.contiguous()]


def build_binary(boxes: Floats, ids: Ints, triangles: int) -> tuple[Floats, Ints]:
    """Build a binary tree over boxes ``(L, 6)`` of primitives ``ids (L,)``; both arrays are permuted.

    A leaf holds at most :data:`~torchpt.search.tree_layout.WIDTH` primitives. Primitives are split down to one a leaf if one of
    them is no triangle (only primitives of one kind are tested together), or if their areas sum to less than the area of their
    bounding box.

    Args:
        boxes: low x, y, z, high x, y, z of each primitive.
        ids: primitive ids; those below ``triangles`` are triangles.
        triangles: number of triangles.

    Returns:
        Boxes ``(M, 6)`` of the nodes, the root first; and ``(M, 3)``: first primitive, one past the last, first child (0 for a
        leaf; the second child follows it).
    """
    nodes, spans = np.empty((2 * len(ids), 6), np.float32), np.empty((2 * len(ids), 3), np.int32)
    used = kernel("tree_build", "build_binary")(boxes, ids, nodes, spans, triangles)
    return nodes[:used], spans[:used]


def wide_tree(boxes: Floats, ids: Ints, counts: tuple[int, ...] = (0, 0)) -> WideTree:
    """Build a wide tree over boxes ``(L, 6)`` of primitives ``ids (L,)``; both arrays are permuted.

    ``counts`` begins with the numbers of triangles and of rectangles, whose ids come first in this order.
    """
    n = len(ids)
    if n == 0:
        no_boxes, no_children = np.full(6 * WIDTH, np.inf, np.float32), np.zeros(WIDTH, np.int32)
        return WideTree(no_boxes, no_children, np.zeros(0, np.int32), depth=1, cost=0.0)
    triangles, rectangles, *_ = counts
    nodes, spans = build_binary(boxes, ids, triangles)
    binary_count = len(nodes)
    # Column k: the least cost of the binary node's subtree as at most k + 1 children of a wide node, and how many of these
    # come from the node's first child. Column 0 says the same of the node as a wide node of its own, and has 0 for a leaf.
    cost = np.empty((binary_count, WIDTH), np.float32)
    decision = np.empty((binary_count, WIDTH), np.int8)
    kernel("tree_build", "choose_collapse")(nodes, spans, ids, triangles, triangles + rectangles, cost, decision)
    # upper bounds, which also count binary nodes that the collapse never reaches
    most_nodes, most_leaves = max(1, int((decision[:, 0] > 0).sum())), int((decision[:, 0] == 0).sum())
    wide_boxes, child = np.empty(most_nodes * 6 * WIDTH, np.float32), np.empty(most_nodes * WIDTH, np.int32)
    leaf_spans = np.empty((most_leaves, 2), np.int32)
    pending, sizes = np.empty((most_nodes + 1, 2), np.int32), np.empty(3, np.int32)
    kernel("tree_build", "collapse")(nodes, spans, decision, wide_boxes, child, leaf_spans, pending, sizes)
    node_count, leaves, depth = sizes.tolist()
    leaf_ids = np.empty((leaves, WIDTH), np.int32)
    kernel("tree_build", "leaf_ids")(leaf_spans[:leaves], ids, leaf_ids)
    x, y, z = (nodes[0, 3:] - nodes[0, :3]).astype(np.float64)
    area = x * y + y * z + z * x  # half the surface of the root's box, as in the costs
    # Expected cost of a random ray through the root's box (MacDonald & Booth 1990).
    expected = float(cost[0, 0] / area) if area > 0 else float(n)
    wide_boxes, child = wide_boxes[: node_count * 6 * WIDTH], child[: node_count * WIDTH]
    return WideTree(wide_boxes, child, leaf_ids.reshape(-1), depth, expected)


def line_count(tree: WideTree, counts: tuple[int, ...]) -> int:
    """Return the size of a tree in cache lines; ``counts`` are the numbers of primitives of each kind."""
    ids = tree.ids.reshape(-1, WIDTH)
    triangles, rectangles, *_ = counts
    with_rectangles = ((ids >= triangles) & (ids < triangles + rectangles)).any(1).sum() if rectangles else 0
    return NODE * tree.nodes + LEAF * tree.leaves + MORE * int(with_rectangles)


def aligned_buffer(count: int) -> Floats:
    """Allocate ``count`` float32, aligned to a cache line."""
    raw = np.zeros(count * 4 + LINE * 4, np.uint8)  # 4 bytes each
    skip = -raw.ctypes.data % (LINE * 4)
    return raw[skip : skip + count * 4].view(np.float32)


def primitive_tables(geometry: Geometry) -> tuple[Floats, Floats, Ints, NonTriangles]:
    """Return what a build reads of each primitive.

    Returns:
        Planes ``(T, 4)`` of the triangles; boxes ``(R, 6)`` and ids ``(R,)`` of the R triangles with an area; and the other
        primitives.
    """
    count = geometry.counts[0]
    planes, boxes, ids = np.empty((count, 4), np.float32), np.empty((count, 6), np.float32), np.empty(count, np.int32)
    with_area = kernel("tree_build", "triangle_tables")(*corners(geometry), count, planes, boxes, ids)
    return planes, boxes[:with_area], ids[:with_area], NonTriangles(geometry)


def mesh_tree(geometry: Geometry) -> tuple[WideTree, Floats, NonTriangles]:
    """Build the tree of a geometry; return it with the planes ``(T, 4)`` of its triangles and its other primitives."""
    planes, boxes, ids, non_triangles = primitive_tables(geometry)
    if non_triangles.area.size:
        with_area = np.flatnonzero(non_triangles.area)
        boxes = np.concatenate([boxes, non_triangles.boxes[with_area]])
        ids = np.concatenate([ids, (with_area + geometry.counts[0]).astype(np.int32)])
    return wide_tree(boxes, ids, geometry.counts), planes, non_triangles


def write_tree(
    tree: WideTree, geometry: Geometry, planes: Floats, non_triangles: NonTriangles, line: int, memory: Floats
) -> None:
    """Write a tree to ``memory``.

    Args:
        tree: the tree.
        geometry: the primitives that it was built of.
        planes: ``(T, 4)`` planes of the triangles.
        non_triangles: the other primitives.
        line: cache line of ``memory`` at which the root is to begin.
        memory: an aligned buffer with at least :func:`line_count` lines from there on.
    """
    codes = memory.view(np.int32)
    triangles, rectangles, *_ = geometry.counts
    first_disk = triangles + rectangles
    corner, rows, _ = non_triangles.tensors
    tables = (planes, corner.numpy(), rows.numpy())
    topology, scratch = (tree.boxes, tree.child, tree.ids), np.empty(tree.nodes, np.int64)
    stack = np.empty(len(tree.child) + WIDTH, np.int32)
    kernel("tree_build", "lay_out")(
        *topology, *corners(geometry), *tables, triangles, first_disk, line, memory, codes, scratch, stack
    )


def corners(geometry: Geometry) -> tuple[Floats, Floats, Floats]:
    """Return the points p0, p1 and p2 of all primitives, ``(3, P)`` each, as arrays."""
    return tuple(p.contiguous().numpy() for p in (geometry.p0, geometry.p1, geometry.p2))  # type: ignore[return-value]


def _without_triangles(geometry: Geometry) -> Geometry:
    triangles, rectangles, disks, spheres, quadrics = geometry.counts
    p0, p1, p2 = (p[:, triangles:] for p in (geometry.p0, geometry.p1, geometry.p2))
    return Geometry(p0, p1, p2, (0, rectangles, disks, spheres, quadrics), geometry.quadrics)
