"""The search by a *wide tree*, a BVH with eight children a node, and its refit when primitives move.

The tree lies in one buffer (:mod:`torchpt.search.tree_layout`), which machine code traverses
(:mod:`torchpt.native.kernels`, modules ``tree_nearest`` and ``tree_occluded``).
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.threads import thread_count
from torchpt.native.kernels import bound_to, kernel, run_parallel
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Array, Hits, Search
from torchpt.search.bounds import select_primitives
from torchpt.search.tree_build import (
    Floats,
    NonTriangles,
    WideTree,
    aligned_buffer,
    corners,
    line_count,
    mesh_tree,
    primitive_tables,
    write_tree,
)
from torchpt.search.tree_layout import LINE, packet_memory, stack_size

__all__ = ["REBUILD_THRESHOLD", "RefitState", "WideBvh", "scene_words"]


# ---- When to refit


#: A tree is rebuilt when refits have raised the expected cost of a random ray by more than this factor since the build. Up
#: to it searches took at most a quarter longer than in a new tree, mostly less than a tenth (scripts/bench_refit.py): with
#: 70,000 triangles a build pays off after about two million rays.
REBUILD_THRESHOLD = 1.2


class RefitState:
    """The state of a tree that refits need.

    Args:
        tree: the tree as built.
        geometry: the primitives of the tree.
        line: cache line of the buffer at which the root begins.

    Attributes:
        sah_ratio: expected cost of a random ray, relative to the tree as built.
    """

    def __init__(self, tree: WideTree, geometry: Geometry, line: int = 0) -> None:
        self.nodes, self.line, self.counts = tree.nodes, line, geometry.counts
        # Ascending ids of the primitives without area, which are not in the tree.
        self.without_area = np.zeros(0, np.int32)
        if (tree.ids >= 0).sum() < geometry.size:
            self.without_area = np.setdiff1d(np.arange(geometry.size, dtype=np.int32), tree.ids)
        self.built_cost: float | None = None  # expected cost as built, computed by the first refit
        self.sah_ratio = 1.0

    def refit(
        self, geometry: Geometry, non_triangles: NonTriangles, before: Floats, memory: Floats
    ) -> RefitState | None:
        """Write this tree, with boxes and leaves of primitives that have moved, and return its state.

        Args:
            geometry: the primitives at their new positions.
            non_triangles: those of them that are not triangles.
            before: the buffer of the present tree, which is not changed.
            memory: the buffer of the new tree, of the same length.

        Returns:
            The new state. None, with undefined content of ``memory``, if the numbers of primitives differ, if a primitive
            without area in the build has one now, if no primitive has an area, or if the cost has grown by more than
            :data:`REBUILD_THRESHOLD`.
        """
        if geometry.counts != self.counts or self._gains_area(geometry):
            return None
        triangles, rectangles, *_ = self.counts
        corner, rows, _ = (x.numpy() for x in non_triangles.tensors)
        first_rectangle, first_disk = triangles, triangles + rectangles
        tables = (first_rectangle, first_disk, corner, rows, non_triangles.boxes)
        codes = before.view(np.int32)
        args = (before, codes, self.line, self.nodes, *corners(geometry), *tables)
        lines, costs = np.empty(self.nodes, np.int64), np.empty(2)  # scratch memory; costs of both trees
        kernel("tree_refit", "refit")(*args, memory, memory.view(np.int32), lines, costs)
        cost_before, cost_moved = costs.tolist()
        state = copy.copy(self)
        state.built_cost = cost_before if self.built_cost is None else self.built_cost
        state.sah_ratio = cost_moved / state.built_cost
        # written so that NaN, the ratio if no primitive has an area, gives None
        return state if state.sah_ratio <= REBUILD_THRESHOLD else None

    def _gains_area(self, geometry: Geometry) -> bool:
        """Return True if a primitive that had no area in the build has one now."""
        if not len(self.without_area):
            return False
        were_without_area = select_primitives(geometry, torch.from_numpy(self.without_area).long())
        _, _, ids, non_triangles = primitive_tables(were_without_area)
        return len(ids) > 0 or bool(non_triangles.area.any())


# ---- The search


#: Fewest rays that are worth another thread.
_GRAIN = 512
#: The argument ``non_opaque`` of kernels if all primitives are opaque.
_ALL_OPAQUE = np.empty(0, np.uint8)


class WideBvh(Accel):
    """A search by a BVH with eight children a node, built by the surface area heuristic, on a CPU.

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; None: torch's number at the time of a search.
    """

    name, refits = "numba", True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        self.threads = threads
        tree, planes, non_triangles = mesh_tree(geometry)
        self.counts, self.depth, self.sah_cost = geometry.counts, tree.depth, tree.cost
        self.nodes, self.leaves = tree.nodes, tree.leaves
        self.refit_state, self.has_instances = RefitState(tree, geometry), geometry.copies is not None
        memory = aligned_buffer(line_count(tree, geometry.counts) * LINE)
        write_tree(tree, geometry, planes, non_triangles, line=0, memory=memory)
        self._set_tables(memory, non_triangles, start)

    def _set_tables(self, memory: np.ndarray, non_triangles: NonTriangles, start: float) -> None:
        """Set what kernels read: the buffer of the tree, and the other primitives. The build began at the time ``start``."""
        self.tables = [memory, *(x.numpy() for x in non_triangles.tensors)]
        self.stack_length = stack_size(self.depth)
        self.words = scene_words(self.tables, self.counts, self.stack_length)
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> WideBvh | None:
        """See :meth:`Accel.refit` and :meth:`RefitState.refit`; the new tree has its own memory."""
        start = time.perf_counter()
        if (geometry.copies is not None) != self.has_instances:
            return None
        non_triangles, memory = NonTriangles(geometry), aligned_buffer(len(self.tables[0]))
        refit_state = self.refit_state.refit(geometry, non_triangles, self.tables[0], memory)
        if refit_state is None:
            return None
        tree = copy.copy(self)
        tree.threads, tree.refit_state = threads, refit_state
        tree._set_tables(memory, non_triangles, start)
        return tree

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        t, u, v = torch.empty_like(t_max), torch.empty_like(t_max), torch.empty_like(t_max)
        prim = torch.empty_like(t_max, dtype=torch.int32)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        self._run("nearest", t_max.shape[0], thread_count(self.threads), *rays, *(x.numpy() for x in (t, prim, u, v)))
        return t, prim, u, v

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        out = torch.empty_like(t_max, dtype=torch.int32)
        rays, results = (x.contiguous().numpy() for x in (o, d, t_max)), (_ALL_OPAQUE, 0, out.numpy())
        self._run("occluded", t_max.shape[0], thread_count(self.threads), *rays, *results)
        return out != 0

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        self.nearest_in(o, d, t_max, t, prim, u, v)(count)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`."""
        self.blocked_in(o, d, t_max, out, non_opaque)(count)

    def nearest_in(self, o: Array, d: Array, t_max: Array, t: Array, prim: Array, u: Array, v: Array) -> Search:
        """See :meth:`Accel.nearest_in`."""
        args = (o, d, t_max, d.shape[1], self.words, t, prim, u, v)
        return bound_to(kernel("tree_nearest", "nearest"), packet_memory(self.stack_length), args)

    def blocked_in(self, o: Array, d: Array, t_max: Array, out: Array, non_opaque: Array | None = None) -> Search:
        """See :meth:`Accel.blocked_in`."""
        flags = _ALL_OPAQUE if non_opaque is None else non_opaque
        args = (o, d, t_max, d.shape[1], self.words, flags, len(flags), out)
        return bound_to(kernel("tree_occluded", "occluded"), packet_memory(self.stack_length), args)

    def _run(self, name: str, count: int, threads: int, o: Array, d: Array, t_max: Array, *results: Any) -> None:
        """Search with the kernel ``name``; the arrays may be longer than the number of rays."""
        args = (o, d, t_max, d.shape[1], self.words, *results)
        run_parallel(kernel(f"tree_{name}", name), count, threads, _GRAIN, packet_memory(self.stack_length), args)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`.

        ``sah_cost`` is that of the tree as built, times the growth of the boxes' areas since then.
        """
        return {
            "name": self.name,
            "primitives": sum(self.counts),
            "nodes": self.nodes,
            "leaves": self.leaves,
            "sah_cost": self.sah_cost * self.refit_state.sah_ratio,
            "depth": self.depth,
            "bytes": sum(x.nbytes for x in (*self.tables, self.words)),
            "build_seconds": self.build_seconds,
        }


def scene_words(tables: Sequence[np.ndarray], counts: Sequence[int], stack_length: int) -> np.ndarray:
    """Return the int64 words by which kernels find a tree.

    Args:
        tables: the buffer of the tree; then the tables :attr:`NonTriangles.tensors`: corners, affine rows and quadrics.
        counts: numbers of triangles, rectangles, disks, spheres and quadrics.
        stack_length: stack size of a ray, see :func:`torchpt.search.tree_layout.stack_size`.

    Returns:
        ``(9,)``: addresses of the tables, which have to be kept alive; ids of the first rectangle, disk, sphere and quadric;
        the stack size.
    """
    first_ids = np.cumsum(counts)[:4]
    return np.array([*(x.ctypes.data for x in tables), *first_ids, stack_length], np.int64)
