"""The CPU's tree: binned SAH, eight children a node, searched by vector kernels."""

from __future__ import annotations

import copy
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.accel import kernels_search as kernels
from torchpt.accel.base import Accel, Array, Hits
from torchpt.accel.blocks import Others, aligned, lines_of, mesh_tree, room_of, write
from torchpt.accel.kernels_blocks import LINE
from torchpt.accel.topology import Topology
from torchpt.core.threads import thread_count
from torchpt.native.jit import compiled, launch
from torchpt.records import Geometry

__all__ = ["Wide"]

_GRAIN = 512  # rays that repay another thread
_ALL_OPAQUE = np.empty(0, np.uint8)


class Wide(Accel):
    """SAH tree with eight children a node (numba, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.
    """

    name, refits = "numba", True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        self.threads = threads
        tree, planes, others = mesh_tree(geometry)
        self.counts, self.depth, self.sah_cost = geometry.counts, tree.depth, tree.cost
        self.nodes, self.leaves = tree.nodes, tree.leaves
        self.topology, self.copied = Topology(tree, geometry), geometry.copies is not None
        memory = aligned(lines_of(tree, geometry.counts) * LINE)
        write(tree, geometry, planes, others, 0, memory)
        self._take(memory, others, start)

    def _take(self, memory: np.ndarray, others: Others, start: float) -> None:
        kinds = torch.tensor([*(sum(self.counts[:k]) for k in range(1, 5)), room_of(self.depth)], dtype=torch.int64)
        self.tensors = [torch.from_numpy(memory), *others.tensors, kinds]
        self.arrays = _arrays(self.tensors)
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> Wide | None:
        """See :meth:`Accel.refit` and :meth:`Topology.refit`; the new tree has memory of its own."""
        start = time.perf_counter()
        if (geometry.copies is not None) != self.copied:
            return None
        others, memory = Others(geometry), aligned(len(self.arrays[0]))
        topology = self.topology.refit(geometry, others, self.arrays[0], memory)
        if topology is None:
            return None
        tree = copy.copy(self)
        tree.threads, tree.topology = threads, topology
        tree._take(memory, others, start)
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
        compiled(kernels.nearest, 0, 0, *args)(0, count, *args)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`."""
        args = (o, d, t_max, *self.arrays, _ALL_OPAQUE if non_opaque is None else non_opaque, out)
        compiled(kernels.blocked, 0, 0, *args)(0, count, *args)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`.

        The cost is what it was when the tree was built, times what the areas of its boxes have grown by since.
        """
        return {
            "name": self.name,
            "primitives": sum(self.counts),
            "nodes": self.nodes,
            "leaves": self.leaves,
            "sah_cost": self.sah_cost * self.topology.growth,
            "depth": self.depth,
            "bytes": sum(x.nbytes for x in self.tensors),
            "build_seconds": self.build_seconds,
        }


def _arrays(tensors: list[Tensor]) -> tuple[np.ndarray, ...]:
    """The kernels' arguments: the tree as float32 and as int32, then the others."""
    tree, *rest = (x.numpy() for x in tensors)
    return tree, tree.view(np.int32), *rest
