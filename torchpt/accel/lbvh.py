"""Linear BVH: built and traversed by tensor operations on any device. The reference for the other backends."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from torchpt.accel import traverse
from torchpt.accel.base import Accel, Hits
from torchpt.accel.bounds import primitive_bounds, surface
from torchpt.accel.radix import Tree, build_tree
from torchpt.accel.tables import inverses, prepare
from torchpt.records import Geometry

__all__ = ["Lbvh"]


class Lbvh(Accel):
    """Morton order, a radix tree over it (Karras 2012), traversal by whole waves of lanes.

    Args:
        geometry: the primitives, on any device.
    """

    name = "torch"

    def __init__(self, geometry: Geometry) -> None:
        start = time.perf_counter()
        tables = prepare(geometry)
        self.counts = list(geometry.counts)
        self.corners = torch.cat([geometry.p0, geometry.p1, geometry.p2]).float()
        self.rows = tables.rows.T.contiguous()
        quadrics = inverses(geometry)
        self.quadrics = quadrics if bool(quadrics[-1].any()) else quadrics[:-1]
        keep = torch.nonzero(tables.area)[:, 0]
        low, high = primitive_bounds(geometry)
        self.tree = build_tree(low[:, keep], high[:, keep], keep)
        self.build_seconds = time.perf_counter() - start

    def _tensors(self) -> list[Tensor]:
        return [self.corners, self.rows, self.quadrics, self.tree.children, self.tree.boxes, self.tree.order]

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        return traverse.intersect(o, d, t_max, self._tensors(), self.counts, self.tree.depth)

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        return traverse.occluded(o, d, t_max, self._tensors(), self.counts, self.tree.depth)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`."""
        return {
            "name": self.name,
            "primitives": sum(self.counts),
            "nodes": self.tree.children.shape[1],
            "leaves": self.tree.order.shape[0],
            "sah_cost": sah_cost(self.tree),
            "depth": self.tree.depth,
            "bytes": sum(x.nbytes for x in self._tensors()),
            "build_seconds": self.build_seconds,
        }


def sah_cost(tree: Tree) -> float:
    """Expected cost of a random ray through the root's box: 1 a node, 1 a primitive (MacDonald & Booth 1990)."""
    if tree.children.shape[1] == 0:
        return float(tree.order.shape[0])
    boxes = tree.boxes.double()
    area = torch.stack([surface(boxes[0:3], boxes[3:6]), surface(boxes[6:9], boxes[9:12])])
    low, high = torch.minimum(boxes[0:3, :1], boxes[6:9, :1]), torch.maximum(boxes[3:6, :1], boxes[9:12, :1])
    return float(1 + area.sum() / surface(low, high).clamp(min=torch.finfo(torch.float64).tiny))
