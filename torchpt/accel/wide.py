"""The CPU's tree: binned SAH, eight children a node, traversed by numba kernels."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.accel import kernels_wide as kernels
from torchpt.accel.base import Accel, Hits
from torchpt.accel.bounds import primitive_bounds
from torchpt.accel.kernels_build import WIDTH, build_binary, collapse
from torchpt.accel.tables import inverses, prepare
from torchpt.native.jit import launch, thread_count
from torchpt.native.operators import choose, operator
from torchpt.records import Geometry

__all__ = ["Wide", "wide_tree"]

_GRAIN = 512  # rays that repay another thread


class Wide(Accel):
    """SAH tree with eight children a node (numba, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; ``None`` is torch's number.
    """

    name = "numba"

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        self.counts = list(geometry.counts)
        self.threads = thread_count(threads)
        tables = prepare(geometry)
        keep = torch.nonzero(tables.area)[:, 0]
        boxes = torch.cat(primitive_bounds(geometry)).T[keep].contiguous().numpy()
        ids = keep.int().numpy()
        fourth = (geometry.p1 + geometry.p2) - geometry.p0
        corner = torch.cat([geometry.p0, geometry.p1, geometry.p2, fourth]).float().T.contiguous()
        tree = wide_tree(boxes, ids)
        self.depth, self.nodes, self.sah_cost = tree.depth, len(tree.child) // WIDTH, tree.cost
        self.leaves = len(tree.ids) // WIDTH
        tris, full = _leaf_blocks(tree.ids, corner.numpy(), geometry.counts[0])
        arrays = (tree.boxes, tree.child, tris, tree.ids, full)
        self.tensors = [*(torch.from_numpy(a) for a in arrays), corner, tables.rows, inverses(geometry).T.contiguous()]
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        return choose(_intersect, _intersect_operator)(o, d, t_max, self.tensors, self.counts, self.depth, self.threads)

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        return choose(_occluded, _occluded_operator)(o, d, t_max, self.tensors, self.counts, self.depth, self.threads)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; the cost is that of the binary tree before it was widened."""
        return {
            "name": self.name,
            "primitives": sum(self.counts),
            "nodes": self.nodes,
            "leaves": self.leaves,
            "sah_cost": self.sah_cost,
            "depth": self.depth,
            "bytes": sum(x.nbytes for x in self.tensors),
            "build_seconds": self.build_seconds,
        }


class _Built:
    def __init__(self, boxes: np.ndarray, child: np.ndarray, ids: np.ndarray, depth: int, cost: float) -> None:
        self.boxes, self.child, self.ids, self.depth, self.cost = boxes, child, ids, depth, cost


def wide_tree(boxes: np.ndarray, ids: np.ndarray) -> _Built:
    """Builds over boxes ``(L, 6)``; ids come back as ``(leaves * 8,)``, padded with -1."""
    n = len(ids)
    if n == 0:
        empty = np.full(6 * WIDTH, np.inf, np.float32)
        return _Built(empty, np.zeros(WIDTH, np.int32), np.zeros(0, np.int32), 1, 0.0)
    nodes, spans = np.empty((2 * n, 6), np.float32), np.empty((2 * n, 3), np.int32)
    used = build_binary(boxes, ids, nodes, spans, WIDTH)
    wide = max(1, int((spans[:used, 2] > 0).sum()))
    flat, child = np.empty(wide * 6 * WIDTH, np.float32), np.empty(wide * WIDTH, np.int32)
    first = np.empty((used, 2), np.int32)
    count, leaves, depth = collapse(nodes, spans, flat, child, first)
    first = first[:leaves]
    place = first[:, :1] + np.arange(WIDTH)
    slots = np.where(place < first[:, 1:], ids[np.minimum(place, n - 1)], -1).astype(np.int32)
    slots = np.where(slots < 0, np.iinfo(np.int32).max, slots)
    slots.sort(axis=1)
    slots = np.where(slots == np.iinfo(np.int32).max, -1, slots)
    cost = _binary_cost(nodes[:used], spans[:used])
    return _Built(
        flat[: count * 6 * WIDTH].copy(), child[: count * WIDTH].copy(), slots.astype(np.int32).reshape(-1), depth, cost
    )


def _binary_cost(nodes: np.ndarray, spans: np.ndarray) -> float:
    """Expected cost of a random ray through the root's box: 1 a node, 1 a primitive (MacDonald & Booth 1990)."""
    size = nodes[:, 3:].astype(np.float64) - nodes[:, :3]
    area = size[:, 0] * size[:, 1] + size[:, 1] * size[:, 2] + size[:, 2] * size[:, 0]
    work = np.where(spans[:, 2] > 0, 1, spans[:, 1] - spans[:, 0])
    return float((area * work).sum() / area[0]) if area[0] > 0 else float(work[0])


def _leaf_blocks(ids: np.ndarray, corner: np.ndarray, triangles: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of each leaf's triangles, component first: ``(leaves * 72,)``; and which slots to test one by one.

    That is -1 where all are triangles (a vector test finds the few to look at), else one bit for each used slot.
    """
    slots = ids.reshape(-1, WIDTH)
    if slots.size == 0:
        return np.zeros(0, np.float32), np.zeros(0, np.int32)
    blocks = corner[:, :9][np.maximum(slots, 0)]  # (leaves, 8, 9)
    blocks[slots < 0] = np.nan
    used = ((slots >= 0) << np.arange(WIDTH)).sum(1)
    full = np.where((slots < triangles).all(1), -1, used).astype(np.int32)
    return np.ascontiguousarray(blocks.transpose(0, 2, 1)).reshape(-1), full


def _intersect(
    o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int, threads: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    t, u, v = (torch.empty_like(t_max) for _ in range(3))
    prim = torch.empty_like(t_max, dtype=torch.int32)
    args = (*_arguments(o, d, t_max, tensors, counts, depth), *(x.numpy() for x in (t, prim, u, v)))
    launch(kernels.intersect, kernels.intersect_parallel, t_max.shape[0], threads, _GRAIN, args)
    return t, prim, u, v


_intersect_operator = operator("torchpt::wide_intersect", _intersect)


@_intersect_operator.register_fake
def _(o, d, t_max, tensors, counts, depth, threads):
    like = torch.empty_like
    return like(t_max), like(t_max, dtype=torch.int32), like(t_max), like(t_max)


def _occluded(
    o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int, threads: int
) -> Tensor:
    prim = torch.empty_like(t_max, dtype=torch.int32)
    args = (*_arguments(o, d, t_max, tensors, counts, depth), prim.numpy())
    launch(kernels.occluded, kernels.occluded_parallel, t_max.shape[0], threads, _GRAIN, args)
    return prim >= 0


_occluded_operator = operator("torchpt::wide_occluded", _occluded)


@_occluded_operator.register_fake
def _(o, d, t_max, tensors, counts, depth, threads):
    return torch.empty_like(t_max, dtype=torch.bool)


def _arguments(o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int) -> tuple:
    rays = tuple(x.contiguous().numpy() for x in (o, d, t_max))
    first = tuple(sum(counts[:k]) for k in range(1, len(counts)))
    return (*rays, tuple(x.numpy() for x in tensors), first, depth * (WIDTH - 1) + WIDTH + 1, 1)
