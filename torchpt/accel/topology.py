"""What a tree in blocks keeps of how it was built, and the same tree for primitives that have moved."""

from __future__ import annotations

import copy

import numpy as np
import torch

from torchpt.accel.blocks import Floats, Others, Tree, corners, tables_of
from torchpt.accel.bounds import chosen
from torchpt.accel.kernels_refit import refit
from torchpt.records import Geometry

__all__ = ["REBUILD", "Topology"]

#: A tree is built anew where moves have made the expected work of a random ray more than this many times what it was when
#: the tree was built. Up to there searches took up to a quarter longer than in a tree built anew, mostly less than a tenth
#: (scripts/bench_refit.py): with 70,000 triangles, a build repays itself after some two million rays then.
REBUILD = 1.2


class Topology:
    """Where a tree lies in its buffer, and what decides whether it can be refitted.

    Args:
        tree: as it was built.
        geometry: over which.
        line: the line of the buffer where its root lies.

    Attributes:
        growth: expected work of a random ray, as a multiple of what it was when the tree was built.
    """

    def __init__(self, tree: Tree, geometry: Geometry, line: int = 0) -> None:
        self.nodes, self.line, self.counts = tree.nodes, line, geometry.counts
        self.left_out = np.zeros(0, np.int32)  # rising ids of what had no area
        if (tree.ids >= 0).sum() < geometry.size:
            self.left_out = np.setdiff1d(np.arange(geometry.size, dtype=np.int32), tree.ids)
        self.built: float | None = None  # the work, which the first refit finds out
        self.growth = 1.0

    def refit(self, geometry: Geometry, others: Others, before: Floats, memory: Floats) -> Topology | None:
        """Fills this tree's part of ``memory`` by that of ``before``, for primitives that have moved.

        None where the counts are others, where a primitive that had no area when the tree was built has one now, where
        nothing has an area, and where the tree has become :data:`REBUILD` times as costly as it was; what ``memory`` holds
        then means nothing.
        """
        if geometry.counts != self.counts or self._is_more(geometry):
            return None
        codes, triangles = before.view(np.int32), self.counts[0]
        corner, rows, _ = (x.numpy() for x in others.tensors)
        tables = (triangles, triangles + self.counts[1], corner, rows, others.boxes)
        args = (before, codes, self.line, self.nodes, *corners(geometry), *tables)
        work, moved = refit(*args, memory, memory.view(np.int32))
        found = copy.copy(self)
        found.built = work if self.built is None else self.built
        found.growth = moved / found.built
        return found if found.growth <= REBUILD else None  # NaN where nothing has an area

    def _is_more(self, geometry: Geometry) -> bool:
        if not len(self.left_out):
            return False
        some = chosen(geometry, torch.from_numpy(self.left_out).long())
        _, _, ids, others = tables_of(some)
        return len(ids) > 0 or bool(others.area.any())
