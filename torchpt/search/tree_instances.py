"""Instances of meshes as a second level of search: a tree over their boxes above the trees of their meshes.

The upper level is a wide tree whose primitives are the boxes of the instances; the lower level has the wide trees of all
distinct meshes in one buffer. Primitives that belong to no instance have a wide tree of their own, which is searched first.
"""

from __future__ import annotations

import time
from copy import copy as shallow
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.threads import thread_count
from torchpt.native.kernels import kernel, run_parallel
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Array, Hits, mark_non_opaque
from torchpt.search.instances import CopyTables
from torchpt.search.tree import RefitState, WideBvh
from torchpt.search.tree_build import (
    NonTriangles,
    WideTree,
    aligned_buffer,
    line_count,
    mesh_tree,
    wide_tree,
    write_tree,
)
from torchpt.search.tree_layout import LINE, instance_memory, stack_size

__all__ = ["InstancedWideBvh", "instance_words"]


#: Fewest rays that are worth another thread.
_GRAIN = 256


class InstancedWideBvh(Accel):
    """A search by wide trees with instances: one tree for the primitives, two levels of trees for the instances, on a CPU.

    Args:
        geometry: the primitives, with instances, on the CPU.
        threads: CPU threads; None: torch's number at the time of a search.
    """

    name = "numba"  # the value of `render.accel` that asks for wide trees, whose kernels were once made by Numba
    refits = True

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        tables = CopyTables(geometry)
        trees, self.refit_states, lower = _build_lower_level(tables.meshes)
        self._lower_nodes, self._lower_leaves = sum(x.nodes for x in trees), sum(x.leaves for x in trees)
        self._lower_depth = max(x.depth for x in trees)
        self._build_upper_level(geometry, WideBvh(geometry, threads), tables, lower, start)

    def _build_upper_level(
        self, geometry: Geometry, base: WideBvh, tables: CopyTables, lower: np.ndarray, start: float
    ) -> None:
        """Build the upper level, and set all attributes.

        Args:
            geometry: the primitives, with instances.
            base: the search over the primitives that belong to no instance.
            tables: the instances.
            lower: the buffer with the trees of the meshes.
            start: time at which the build or refit began.
        """
        assert geometry.copies is not None
        # Rows 12 to 14: of each instance the mesh's first triangle, number of triangles, and the first primitive id.
        self.base, self.threads, self.spans = base, base.threads, geometry.copies[12:]
        not_empty = np.flatnonzero([tables.meshes[k].size > 0 for k in tables.mesh.tolist()]).astype(np.int32)
        boxes = torch.cat((tables.low, tables.high)).T.contiguous().numpy()[not_empty]
        top = wide_tree(boxes, not_empty.copy())  # the build permutes the ids
        # the leaves of the upper level have ids of instances, and no triangles
        none = _no_primitives()
        upper = aligned_buffer(line_count(top, none.counts) * LINE)
        write_tree(top, none, np.zeros((0, 4), np.float32), NonTriangles(none), line=0, memory=upper)
        self.depth = top.depth + self._lower_depth
        # A code is a reference to a node or leaf, see tree_layout.py: here the root node of each mesh's tree.
        roots = np.array([4 * state.line for state in self.refit_states], np.int64)
        self.tables = (
            upper, lower, tables.inverse.numpy(), tables.shift.numpy().astype(np.int32), roots[tables.mesh.numpy()]
        )  # fmt: skip
        self.stack_length = stack_size(self.depth)
        self.words = instance_words(self.tables, self.stack_length)
        self.copies = len(not_empty)
        self.nodes, self.leaves = top.nodes + self._lower_nodes, top.leaves + self._lower_leaves
        self.primitives = int(geometry.size + geometry.copies[13].sum())  # row 13: triangles of each instance
        self.build_seconds = time.perf_counter() - start

    def refit(self, geometry: Geometry, threads: int | None = None) -> InstancedWideBvh | None:
        """See :meth:`Accel.refit`; the upper level, which is small, is always rebuilt."""
        start = time.perf_counter()
        # the meshes of the instances have to be the same triangles
        if geometry.copies is None or not torch.equal(geometry.copies[12:], self.spans):
            return None
        base = self.base.refit(geometry, threads)
        if base is None:
            return None
        tables, states = CopyTables(geometry), []
        _, lower_before, *_ = self.tables
        lower = aligned_buffer(len(lower_before))
        for refit_state, mesh in zip(self.refit_states, tables.meshes, strict=True):
            # instances of empty meshes are not in the upper level
            moved = refit_state if not mesh.size else refit_state.refit(mesh, NonTriangles(mesh), lower_before, lower)
            if moved is None:
                return None
            states.append(moved)
        tree = shallow(self)
        tree.refit_states = states
        tree._build_upper_level(geometry, base, tables, lower, start)
        return tree

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        hits = self.base._intersect(o, d, t_max)
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        self._run("nearest", t_max.shape[0], thread_count(self.threads), *rays, *(x.numpy() for x in hits))
        return hits

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        out = self.base._occluded(o, d, t_max).int()
        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        self._run("occluded", t_max.shape[0], thread_count(self.threads), *rays, out.numpy())
        return out != 0

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        self.base.nearest(o, d, t_max, count, t, prim, u, v)
        self._run("nearest", count, 1, o, d, t_max, t, prim, u, v)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`; with ``non_opaque`` every ray with a hit gets 2 (compute its transmittance)."""
        self.base.blocked(o, d, t_max, count, out)
        self._run("occluded", count, 1, o, d, t_max, out)
        mark_non_opaque(out[:count], non_opaque)

    def _run(self, name: str, count: int, threads: int, o: Array, d: Array, t_max: Array, *results: Array) -> None:
        """Search the instances with the kernel ``name``, and update the results of the search among the other primitives."""
        args = (o, d, t_max, d.shape[1], self.words, *results)
        run_parallel(
            kernel(f"instances_{name}", name), count, threads, _GRAIN, instance_memory(self.stack_length), args
        )

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; nodes, leaves and bytes count each mesh once, the cost leaves instances out."""
        base = self.base.describe()
        return base | {
            "primitives": self.primitives,
            "instances": self.copies,
            "nodes": base["nodes"] + self.nodes,
            "leaves": base["leaves"] + self.leaves,
            "bytes": base["bytes"] + sum(x.nbytes for x in self.tables),
            "depth": max(base["depth"], self.depth),
            "build_seconds": self.build_seconds,
        }


def _no_primitives() -> Geometry:
    """Return a geometry without primitives."""
    none = torch.zeros(3, 0, dtype=torch.float32)
    return Geometry(none, none, none, (0, 0, 0, 0, 0))


def _build_lower_level(meshes: list[Geometry]) -> tuple[list[WideTree], list[RefitState], np.ndarray]:
    """Build the trees of all meshes in one buffer; return the trees, the states for their refits, and the buffer."""
    built = [mesh_tree(mesh) for mesh in meshes]
    sizes = [line_count(tree, mesh.counts) for (tree, _, _), mesh in zip(built, meshes, strict=True)]
    *first_lines, all_lines = np.cumsum([0, *sizes]).tolist()
    memory = aligned_buffer(all_lines * LINE)
    for (tree, planes, non_triangles), mesh, line in zip(built, meshes, first_lines, strict=True):
        write_tree(tree, mesh, planes, non_triangles, line, memory)
    trees = [tree for tree, _, _ in built]
    return trees, [RefitState(*args) for args in zip(trees, meshes, first_lines, strict=True)], memory


def instance_words(tables: tuple[np.ndarray, ...], stack_length: int) -> np.ndarray:
    """Return the int64 words by which kernels find instances.

    Args:
        tables: tree over the instances' boxes; trees of all meshes, one after the other; transforms ``(I, 12)`` float64 from
            the world to the meshes; ``(I,)`` int32, added to a triangle's number in its mesh to get its id in the instance;
            ``(I,)`` int64 codes of the meshes' roots.
        stack_length: stack size of a ray.

    Returns:
        ``(6,)``: addresses of the tables, which have to be kept alive, and the stack size.
    """
    return np.array([*(x.ctypes.data for x in tables), stack_length], np.int64)
