"""Copies on the CPU: a wide tree over their boxes above the wide trees of their meshes (numba)."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.accel import kernels_instances as kernels
from torchpt.accel.base import Accel, Hits
from torchpt.accel.instances import CopyTables
from torchpt.accel.kernels_build import WIDTH
from torchpt.accel.wide import Wide, wide_tree
from torchpt.native.jit import launch, thread_count
from torchpt.records import Geometry

__all__ = ["WideInstanced"]

_GRAIN = 256  # rays that repay another thread


class WideInstanced(Accel):
    """The primitives in one wide tree, and two levels of them for the copies.

    Args:
        geometry: with copies, on the CPU.
        threads: CPU threads; ``None`` is torch's number.
    """

    name = "numba"

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        assert geometry.copies is not None
        self.threads = thread_count(threads)
        self.base = Wide(geometry, threads)
        tables = CopyTables(geometry)
        trees = [Wide(mesh, threads) for mesh in tables.meshes]
        self.lower, roots, rows = _concatenated(trees)
        self.matrix = tables.inverse.numpy()
        self.roots = roots[tables.mesh.numpy()]
        self.shift = (tables.shift.numpy() - rows[tables.mesh.numpy()]).astype(np.int32)
        some = np.flatnonzero([tables.meshes[k].size > 0 for k in tables.mesh.tolist()]).astype(np.int32)
        boxes = torch.cat((tables.low, tables.high)).T.contiguous().numpy()[some]
        upper = wide_tree(boxes, some.copy())
        self.upper = (upper.boxes, upper.child, upper.ids)
        self.depth = upper.depth + max(tree.depth for tree in trees)
        self.room = self.depth * (WIDTH - 1) + 2 * (WIDTH + 1)
        self.copies, self.trees = len(some), [tree.describe() for tree in trees]
        self.ids = int(geometry.size + geometry.copies[13].sum())
        self.build_seconds = time.perf_counter() - start

    def _run(self, o: Tensor, d: Tensor, t_max: Tensor, any_hit: bool, hits: Hits) -> None:
        rays = tuple(x.contiguous().numpy() for x in (o, d, t_max))
        tables = (self.upper, self.lower, self.matrix, self.shift, self.roots, self.room, 1, any_hit)
        args = (*rays, *tables, *(x.numpy() for x in hits))
        launch(kernels.trace, kernels.trace_parallel, t_max.shape[0], self.threads, _GRAIN, args)

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        hits = self.base._intersect(o, d, t_max)
        self._run(o, d, t_max, False, hits)
        return hits

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        prim = self.base._occluded(o, d, t_max).int() - 1
        t, u, v = torch.full_like(t_max, torch.inf), torch.zeros_like(t_max), torch.zeros_like(t_max)
        self._run(o, d, t_max, True, (t, prim, u, v))
        return prim >= 0

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; nodes, leaves and bytes count each mesh once, the cost is that of what is no copy."""
        base = self.base.describe()
        above = (*self.upper, self.matrix, self.shift, self.roots)
        return base | {
            "primitives": self.ids,
            "instances": self.copies,
            "nodes": base["nodes"] + sum(tree["nodes"] for tree in self.trees) + len(self.upper[1]) // WIDTH,
            "leaves": base["leaves"] + sum(tree["leaves"] for tree in self.trees) + len(self.upper[2]) // WIDTH,
            "bytes": base["bytes"] + sum(x.nbytes for x in (*self.lower, *above)),
            "depth": max(base["depth"], self.depth),
            "build_seconds": self.build_seconds,
        }


def _concatenated(trees: list[Wide]) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Trees one after the other, with their nodes, leaves and triangles renumbered; roots and first rows of each."""
    columns: list[list[np.ndarray]] = [[] for _ in range(8)]
    roots, rows = [], []
    node = leaf = row = 0
    for tree in trees:
        boxes, child, leaves, ids, full, corner, planes, quadrics = (x.numpy() for x in tree.tensors)
        roots.append(node)
        rows.append(row)
        child = np.where(child >= 0, child + node, child - leaf).astype(np.int32)
        ids = np.where(ids >= 0, ids + row, ids).astype(np.int32)
        for column, x in zip(columns, (boxes, child, leaves, ids, full, corner, planes, quadrics), strict=True):
            column.append(x)
        node, leaf, row = node + len(child) // WIDTH, leaf + len(full), row + len(corner)
    return (
        tuple(np.concatenate(column) for column in columns),
        np.array(roots, np.int32),
        np.array(rows, np.int64),
    )
