"""A linear BVH by tensor operations, on any device: built by Morton codes, traversed lane by lane."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.bounds import half_areas, primitive_bounds
from torchpt.search.leaf import Rays, distances, prepare_rays
from torchpt.search.tables import affine_rows, quadric_rows

__all__ = ["Lbvh", "RadixTree", "build_tree", "intersect", "morton_codes", "occluded"]


# ---- The radix tree over Morton codes, by tensor operations without a loop over primitives
#
# Karras, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", HPG 2012.


_BITS = 21


class RadixTree(NamedTuple):
    """A binary tree over sorted primitives; node 0 is the root.

    Attributes:
        children: ``(2, M)`` int32; a negative value ``~k`` is the leaf that holds sorted primitive ``k``.
        boxes: ``(12, M)`` float32: low and high corner of the first child, then of the second.
        order: ``(L,)`` int32: primitive ids in Morton order.
        depth: nodes on the longest way from the root to a leaf.
    """

    children: Tensor
    boxes: Tensor
    order: Tensor
    depth: int


def morton_codes(centre: Tensor) -> Tensor:
    """63-bit Morton codes of points ``(3, N)`` within their own bounds, int64; a flat axis gives zeros."""
    low = centre.amin(1, keepdim=True)
    size = (centre.amax(1, keepdim=True) - low).clamp(min=torch.finfo(torch.float64).tiny)
    cell = ((centre - low) / size * 2**_BITS).long().clamp(0, 2**_BITS - 1)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        cell = (cell | (cell << shift)) & mask
    return (cell[0] << 2) | (cell[1] << 1) | cell[2]


def build_tree(low: Tensor, high: Tensor, ids: Tensor) -> RadixTree:
    """Builds the tree of primitives with boxes ``low, high`` ``(3, L)`` and primitive ids ``ids`` ``(L,)``.

    Equal codes are told apart by their place in the stable order, so that a million coincident centroids give a
    balanced tree. Boxes come from range minima over the sorted leaves: log L steps, whatever the depth.
    """
    n, device = ids.shape[0], ids.device
    if n < 2:
        # a root with one leaf, or none; the second child's box is empty
        boxes = torch.full((12, min(n, 1)), torch.inf, device=device)
        boxes[9:12] = -torch.inf
        boxes[0:3], boxes[3:6] = low, high
        return RadixTree(torch.full((2, min(n, 1)), -1, dtype=torch.int32, device=device), boxes, ids.int(), min(n, 1))
    codes, perm = torch.sort(morton_codes(low.double() / 2 + high.double() / 2), stable=True)
    low, high, order = low[:, perm], high[:, perm], ids[perm].int().contiguous()
    left, right, split = _ranges(codes >> 1)  # room above for "outside"; the lost bit is settled by place
    node = torch.arange(n - 1, device=device)
    first = torch.where(split == left, ~split, split)
    second = torch.where(split + 1 == right, ~(split + 1), split + 1)
    children = torch.stack([first, second]).int().contiguous()
    boxes = torch.cat([*_range_boxes(low, high, left, split), *_range_boxes(low, high, split + 1, right)])
    parent = torch.zeros(n - 1, dtype=torch.long, device=device)
    for child in (first, second):
        inner = child >= 0
        parent[child[inner]] = node[inner]
    return RadixTree(children, boxes.contiguous(), order, _depth(parent))


def _below(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> Tensor:
    """Whether the highest set bit of a is below b's; a and b are (xor of codes, xor of places)."""
    (ca, ia), (cb, ib) = a, b
    codes = (ca < cb) & (ca < (ca ^ cb))
    places = (ia < ib) & (ia < (ia ^ ib))
    return torch.where(ca | cb != 0, codes, places)


def _ranges(codes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For each of the n - 1 nodes: first leaf, last leaf, and the last leaf of the first child (Karras, fig. 4)."""
    n = codes.shape[0]
    i = torch.arange(n - 1, device=codes.device)
    big = torch.full_like(i, torch.iinfo(torch.int64).max)

    def differ(j: Tensor) -> tuple[Tensor, Tensor]:
        inside = (j >= 0) & (j < n)
        k = j.clamp(0, n - 1)
        return torch.where(inside, codes[i] ^ codes[k], big), torch.where(inside, i ^ k, big)

    d = torch.where(_below(differ(i + 1), differ(i - 1)), 1, -1)
    limit = differ(i - d)
    steps = math.ceil(math.log2(n)) + 1
    length = torch.zeros_like(i)
    for k in reversed(range(steps)):
        further = length + (1 << k)
        length = torch.where(_below(differ(i + further * d), limit), further, length)
    end = i + length * d
    whole = differ(end)
    s = torch.zeros_like(i)
    for k in reversed(range(steps)):
        further = s + (1 << k)
        s = torch.where((further < length) & _below(differ(i + further * d), whole), further, s)
    split = i + s * d + torch.minimum(d, torch.zeros_like(d))
    return torch.minimum(i, end), torch.maximum(i, end), split


def _range_boxes(low: Tensor, high: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Boxes of the leaves ``first..last``: two overlapping powers of two cover any range (a sparse table)."""
    count = last - first + 1
    out_low, out_high = torch.empty_like(low[:, : len(first)]), torch.empty_like(high[:, : len(first)])
    width = 1
    while True:
        mine = torch.nonzero((count >= width) & (count < 2 * width))[:, 0]
        a, b = first[mine], last[mine] - (width - 1)
        out_low[:, mine] = torch.minimum(low[:, a], low[:, b])
        out_high[:, mine] = torch.maximum(high[:, a], high[:, b])
        if 2 * width > low.shape[1] + width:
            return out_low, out_high
        low = torch.minimum(low[:, :-width], low[:, width:])
        high = torch.maximum(high[:, :-width], high[:, width:])
        width *= 2


def _depth(parent: Tensor) -> int:
    """Length of the longest chain of parents, by pointer jumping."""
    steps = (parent != torch.arange(len(parent), device=parent.device)).long()
    steps[0] = 0
    while bool((parent != 0).any()):
        steps, parent = steps + steps[parent], parent[parent]
    return int(steps.max()) + 1


# ---- Traversal of the radix tree by a whole wave: each step moves every live lane by one node


#: Lanes that travel together; bounds memory to some 100 MB.
CHUNK = 1 << 18
_DONE = 1 << 30
#: Boxes are enlarged by 16 ulps of the distance: the slabs' own error is 3 (Ize, "Robust BVH Ray Traversal", 2013).
_SLACK = 1.0 + 2.0**-20


def intersect(
    o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Nearest hits; arguments as :class:`torchpt.search.lbvh.Lbvh` holds them."""
    t, prim = torch.full_like(t_max, torch.inf), torch.full_like(t_max, -1, dtype=torch.int32)
    u, v = torch.zeros_like(t_max), torch.zeros_like(t_max)
    for lanes in _live(o, d, t_max):
        hit, found = _Wave(o, d, t_max, lanes, tensors, counts, depth).run(any_hit=False)
        t[hit], prim[hit], u[hit], v[hit] = found[0], found[1].int(), found[2], found[3]
    return t, prim, u, v


def occluded(o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int) -> Tensor:
    """Return True where a ray hits anything; arguments as for :func:`intersect`."""
    blocked = torch.zeros_like(t_max, dtype=torch.bool)
    for lanes in _live(o, d, t_max):
        hit, _ = _Wave(o, d, t_max, lanes, tensors, counts, depth).run(any_hit=True)
        blocked[hit] = True
    return blocked


def _live(o: Tensor, d: Tensor, t_max: Tensor) -> list[Tensor]:
    """Places of the rays that can hit anything, in chunks."""
    good = (t_max > 0) & torch.isfinite(o).all(0) & torch.isfinite(d).all(0) & (d != 0).any(0)
    return [c for c in torch.nonzero(good)[:, 0].split(CHUNK) if c.numel()]


class _Wave:
    """The state of the lanes that still travel, and the hits of those that do not."""

    def __init__(
        self, o: Tensor, d: Tensor, t_max: Tensor, lanes: Tensor, tensors: list[Tensor], counts: list[int], depth: int
    ) -> None:
        self.corners, self.rows, self.quadrics, self.children, self.boxes, self.order = tensors
        self.counts = counts
        self.lanes = lanes
        self.rays = prepare_rays(o[:, lanes], d[:, lanes])
        self.t = t_max[lanes].clone()
        self.prim = torch.full_like(lanes, -1)
        self.u, self.v = torch.zeros_like(self.t), torch.zeros_like(self.t)
        self.node = torch.full_like(lanes, 0 if self.children.shape[1] else _DONE)
        self.top = torch.zeros_like(lanes)  # entries on the stack
        self.stack = torch.full((depth + 1, len(lanes)), _DONE, dtype=torch.int32, device=lanes.device)
        self.finished: list[tuple[Tensor, ...]] = []

    def run(self, any_hit: bool) -> tuple[Tensor, list[Tensor]]:
        """Travels to the end: places of the rays that hit, and their ``t, prim, u, v``."""
        step = 0
        while True:
            inner = torch.nonzero((self.node >= 0) & (self.node < _DONE))[:, 0]
            leaf = torch.nonzero(self.node < 0)[:, 0]
            live = inner.numel() + leaf.numel()
            if live == 0:
                break
            if step % 8 == 7 and 2 * live < self.node.numel():
                self._compact()
            else:
                if inner.numel():
                    self._descend(inner)
                if leaf.numel():
                    self._test(leaf, any_hit)
            step += 1
        self._retire(slice(None))
        lanes, *found = (torch.cat(x) for x in zip(*self.finished, strict=True))
        hit = found[1] >= 0
        return lanes[hit], [x[hit] for x in found]

    def _retire(self, which: Tensor | slice) -> None:
        self.finished.append(tuple(x[which] for x in (self.lanes, self.t, self.prim, self.u, self.v)))

    def _compact(self) -> None:
        """Puts finished lanes aside."""
        done = self.node == _DONE
        self._retire(done)
        keep = torch.nonzero(~done)[:, 0]
        self.rays = self.rays.take(keep)
        self.lanes, self.t, self.prim = self.lanes[keep], self.t[keep], self.prim[keep]
        self.u, self.v, self.node, self.top = self.u[keep], self.v[keep], self.node[keep], self.top[keep]
        self.stack = self.stack[:, keep]

    def _pop(self, lanes: Tensor) -> Tensor:
        """The next node of these lanes; row 0 of the stack says that nothing is left."""
        top = self.top[lanes]
        self.top[lanes] = (top - 1).clamp(min=0)
        return self.stack[top, lanes].long()

    def _descend(self, lanes: Tensor) -> None:
        node = self.node[lanes]
        ray, box, t = self.rays.take(lanes), self.boxes[:, node], self.t[lanes]
        near0, hit0 = _slabs(ray, box[0:6], t)
        near1, hit1 = _slabs(ray, box[6:12], t)
        first, second = self.children[:, node].long().unbind(0)
        swap = near1 < near0
        nearer, farther = torch.where(swap, second, first), torch.where(swap, first, second)
        both = hit0 & hit1
        deeper = torch.nonzero(both)[:, 0]
        rows = self.top[lanes[deeper]] + 1
        self.stack[rows, lanes[deeper]] = farther[deeper].int()
        self.top[lanes[deeper]] = rows
        self.node[lanes] = torch.where(both, nearer, torch.where(hit0, first, second))
        none = lanes[~(hit0 | hit1)]
        self.node[none] = self._pop(none)

    def _test(self, lanes: Tensor, any_hit: bool) -> None:
        prim = self.order[~self.node[lanes]].long()
        t, u, v = distances(self.rays.take(lanes), prim, self.corners, self.rows, self.quadrics, self.counts)
        best = self.t[lanes]
        better = (t > 0) & ((t < best) | ((t == best) & (prim < self.prim[lanes])))
        won = lanes[better]
        self.t[won], self.prim[won], self.u[won], self.v[won] = t[better], prim[better], u[better], v[better]
        self.node[lanes] = self._pop(lanes)
        if any_hit:
            self.node[won] = _DONE


def _slabs(ray: Rays, box: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor]:
    """Entry distances into boxes ``(6, N)``, and whether they are met before ``t_max`` (conservative)."""
    a, b = (box[0:3] - ray.o) * ray.inverse, (box[3:6] - ray.o) * ray.inverse
    near = torch.minimum(a, b).amax(0).clamp(min=0.0)
    far = torch.minimum(torch.maximum(a, b).amin(0), t_max) * _SLACK
    return near, near <= far


# ---- Linear BVH: built and traversed by tensor operations on any device. The reference for the other backends


class Lbvh(Accel):
    """Morton order, a radix tree over it (Karras 2012), traversal by whole waves of lanes.

    Args:
        geometry: the primitives, on any device.
    """

    name = "torch"

    def __init__(self, geometry: Geometry) -> None:
        start = time.perf_counter()
        tables = affine_rows(geometry)
        self.counts = list(geometry.counts)
        self.corners = torch.cat([geometry.p0, geometry.p1, geometry.p2]).float()
        self.rows = tables.rows.T.contiguous()
        quadrics = quadric_rows(geometry)
        self.quadrics = quadrics if bool(quadrics[-1].any()) else quadrics[:-1]
        keep = torch.nonzero(tables.area)[:, 0]
        low, high = primitive_bounds(geometry)
        self.tree = build_tree(low[:, keep], high[:, keep], keep)
        self.build_seconds = time.perf_counter() - start

    def _tensors(self) -> list[Tensor]:
        return [self.corners, self.rows, self.quadrics, self.tree.children, self.tree.boxes, self.tree.order]

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        return intersect(o, d, t_max, self._tensors(), self.counts, self.tree.depth)

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        return occluded(o, d, t_max, self._tensors(), self.counts, self.tree.depth)

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


def sah_cost(tree: RadixTree) -> float:
    """Expected cost of a random ray through the root's box: 1 a node, 1 a primitive (MacDonald & Booth 1990)."""
    if tree.children.shape[1] == 0:
        return float(tree.order.shape[0])
    boxes = tree.boxes.double()
    area = torch.stack([half_areas(boxes[0:3], boxes[3:6]), half_areas(boxes[6:9], boxes[9:12])])
    low, high = torch.minimum(boxes[0:3, :1], boxes[6:9, :1]), torch.maximum(boxes[3:6, :1], boxes[9:12, :1])
    return float(1 + area.sum() / half_areas(low, high).clamp(min=torch.finfo(torch.float64).tiny))
