"""Copies on the CPU: a tree over their boxes above the trees of their meshes (numba)."""

from __future__ import annotations

import copy
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.accel import kernels_instances as kernels
from torchpt.accel.base import Accel, Array, Hits, closer
from torchpt.accel.blocks import Others, Tree, aligned, lines_of, mesh_tree, room_of, wide_tree, write
from torchpt.accel.instances import CopyTables
from torchpt.accel.kernels_blocks import LINE
from torchpt.accel.topology import Topology
from torchpt.accel.wide import Wide
from torchpt.core.threads import thread_count
from torchpt.native.jit import compiled, launch
from torchpt.records import Geometry

__all__ = ["WideInstanced"]

_GRAIN = 256  # rays that repay another thread


class WideInstanced(Accel):
    """The primitives in one wide tree, and two levels of them for the copies.

    Args:
        geometry: with copies, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.
    """

    name, refits = "numba", True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        tables = CopyTables(geometry)
        trees, self.topologies, lower = _meshes(tables.meshes)
        self._below = [sum(x.nodes for x in trees), sum(x.leaves for x in trees), max(x.depth for x in trees)]
        self._take(geometry, Wide(geometry, threads), tables, lower, start)

    def _take(self, geometry: Geometry, base: Wide, tables: CopyTables, lower: np.ndarray, start: float) -> None:
        """Builds the upper level."""
        assert geometry.copies is not None
        self.base, self.threads, self.places = base, base.threads, geometry.copies[12:]
        some = np.flatnonzero([tables.meshes[k].size > 0 for k in tables.mesh.tolist()]).astype(np.int32)
        boxes = torch.cat((tables.low, tables.high)).T.contiguous().numpy()[some]
        top = wide_tree(boxes, some.copy())
        none = _nothing()
        upper = aligned(lines_of(top, none.counts) * LINE)
        write(top, none, np.zeros((0, 4), np.float32), Others(none), 0, upper)
        nodes, leaves, depth = self._below
        depth += top.depth
        roots = np.array([4 * x.line for x in self.topologies], np.int64)
        self.arrays = (
            upper, upper.view(np.int32), lower, lower.view(np.int32), tables.inverse.numpy(),
            tables.shift.numpy().astype(np.int32), roots[tables.mesh.numpy()], room_of(depth),
        )  # fmt: skip
        self.depth, self.copies, self.nodes, self.leaves = depth, len(some), top.nodes + nodes, top.leaves + leaves
        self.ids = int(geometry.size + geometry.copies[13].sum())
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> WideInstanced | None:
        """See :meth:`Accel.refit`; the upper level, of a few boxes beside the primitives', is always built anew."""
        start = time.perf_counter()
        if geometry.copies is None or not torch.equal(geometry.copies[12:], self.places):
            return None
        base = self.base.refit(geometry, threads)
        if base is None:
            return None
        tables, before, found = CopyTables(geometry), self.arrays[2], []
        lower = aligned(len(before))
        for topology, mesh in zip(self.topologies, tables.meshes, strict=True):
            # no copy of an empty mesh is in the upper level
            moved = topology if not mesh.size else topology.refit(mesh, Others(mesh), before, lower)
            if moved is None:
                return None
            found.append(moved)
        tree = copy.copy(self)
        tree.topologies = found
        tree._take(geometry, base, tables, lower, start)
        return tree

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        hits = self.base._intersect(o, d, t_max)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, *(x.numpy() for x in hits))
        launch(kernels.nearest, kernels.nearest_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return hits

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        out = self.base._occluded(o, d, t_max).int()
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, out.numpy())
        launch(kernels.blocked, kernels.blocked_parallel, t_max.shape[0], thread_count(self.threads), _GRAIN, args)
        return out != 0

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        self.base.nearest(o, d, t_max, count, t, prim, u, v)
        args = (o, d, t_max, *self.arrays, t, prim, u, v)
        compiled(kernels.nearest, 0, 0, *args)(0, count, *args)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`; where there are non_opaque, every ray that meets anything is to be looked at closer."""
        self.base.blocked(o, d, t_max, count, out)
        args = (o, d, t_max, *self.arrays, out)
        compiled(kernels.blocked, 0, 0, *args)(0, count, *args)
        closer(out[:count], non_opaque)

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


def _meshes(meshes: list[Geometry]) -> tuple[list[Tree], list[Topology], np.ndarray]:
    """The trees of all meshes, where they lie, and their blocks one after the other."""
    built = [mesh_tree(mesh) for mesh in meshes]
    lines = [lines_of(tree, mesh.counts) for (tree, _, _), mesh in zip(built, meshes, strict=True)]
    lines = np.cumsum([0, *lines]).tolist()
    memory = aligned(lines[-1] * LINE)
    for (tree, planes, others), mesh, line in zip(built, meshes, lines[:-1], strict=True):
        write(tree, mesh, planes, others, line, memory)
    trees = [tree for tree, _, _ in built]
    return trees, [Topology(*args) for args in zip(trees, meshes, lines[:-1], strict=True)], memory
