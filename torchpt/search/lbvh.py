"""A linear BVH by tensor operations on any device: built from Morton codes, traversed by all rays in lockstep.

It is the search of tensors on GPUs, and the reference for the other backends. A *lane* is a ray of those that are traversed
together. A node is the index of an inner node, ``~k`` for leaf k, or ``_DONE`` for a lane that is finished.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.bounds import half_areas, primitive_bounds
from torchpt.search.leaf import Rays, distances, prepare_rays
from torchpt.search.tables import affine_rows, quadric_rows

__all__ = ["Lbvh"]


# ---- Build: a radix tree over Morton codes, by tensor operations without a loop over primitives
#
# Karras, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", HPG 2012.


#: Bits of a Morton code for each axis: three times as many fit in an int64.
_BITS = 21


class RadixTree(NamedTuple):
    """A binary tree over sorted primitives; node 0 is the root.

    Attributes:
        children: ``(2, M)`` int32; a negative value ``~k`` is the leaf that holds sorted primitive ``k``.
        boxes: ``(12, M)`` float32: low and high corner of the first child, then of the second.
        order: ``(L,)`` int32: primitive ids in Morton order.
        depth: nodes on the longest path from the root to a leaf.
    """

    children: Tensor
    boxes: Tensor
    order: Tensor
    depth: int


def morton_codes(centre: Tensor) -> Tensor:
    """Compute 63-bit Morton codes of points ``(3, N)`` within their bounds, int64; an axis without extent gives zeros."""
    low = centre.amin(1, keepdim=True)
    size = (centre.amax(1, keepdim=True) - low).clamp(min=torch.finfo(torch.float64).tiny)
    cell = ((centre - low) / size * 2**_BITS).long().clamp(0, 2**_BITS - 1)
    # Spread the bits of each axis, two zeros after each: halves of the remaining groups of bits move apart in turn.
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
    """Build the tree of primitives with boxes ``low, high`` ``(3, L)`` and primitive ids ``ids`` ``(L,)``.

    Equal codes are distinguished by their index in the stable order, so that a million coincident centroids give a balanced
    tree. Boxes are range minima and maxima over the sorted leaves: log L steps, whatever the depth.
    """
    n, device = ids.shape[0], ids.device
    if n < 2:
        # a root with one leaf, or none; the second child's box is empty
        boxes = torch.full((12, min(n, 1)), torch.inf, dtype=torch.float32, device=device)
        boxes[9:12] = -torch.inf
        boxes[0:3], boxes[3:6] = low, high
        return RadixTree(torch.full((2, min(n, 1)), -1, dtype=torch.int32, device=device), boxes, ids.int(), min(n, 1))
    codes, perm = torch.sort(morton_codes(low.double() / 2 + high.double() / 2), stable=True)
    low, high, order = low[:, perm], high[:, perm], ids[perm].int().contiguous()
    # Shifted, as the largest int64 stands for "outside"; codes that differ in the lost bit alone count as equal.
    left, right, split = _ranges(codes >> 1)
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
    """Return True where the highest set bit of a is below that of b.

    ``a`` and ``b`` are pairs: xor of two leaves' codes, and of their indices, which count where both of the codes' are 0. In
    the terms of Karras the common prefix of the leaves of ``a`` is longer than that of ``b``.
    """
    (codes_a, indices_a), (codes_b, indices_b) = a, b
    by_codes = (codes_a < codes_b) & (codes_a < (codes_a ^ codes_b))
    by_indices = (indices_a < indices_b) & (indices_a < (indices_a ^ indices_b))
    return torch.where(codes_a | codes_b != 0, by_codes, by_indices)


def _ranges(codes: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return for each of the n - 1 nodes: first leaf, last leaf, and the last leaf of the first child (Karras, fig. 4)."""
    n = codes.shape[0]
    i = torch.arange(n - 1, device=codes.device)
    big = torch.full_like(i, torch.iinfo(torch.int64).max)

    def differ(j: Tensor) -> tuple[Tensor, Tensor]:
        """Return the xor of codes and of indices of leaves i and j; the largest numbers where j is no leaf."""
        inside = (j >= 0) & (j < n)
        k = j.clamp(0, n - 1)
        return torch.where(inside, codes[i] ^ codes[k], big), torch.where(inside, i ^ k, big)

    # Node i covers the leaves from i on in direction d, +1 or -1, as long as they have more in common with leaf i than the leaf
    # on its other side has. Their number, then the split within them, by binary search.
    d = torch.where(_below(differ(i + 1), differ(i - 1)), 1, -1)
    limit = differ(i - d)
    steps = math.ceil(math.log2(n)) + 1
    length = torch.zeros_like(i)
    for k in reversed(range(steps)):
        further = length + (1 << k)
        length = torch.where(_below(differ(i + further * d), limit), further, length)
    end = i + length * d
    of_all = differ(end)
    offset = torch.zeros_like(i)
    for k in reversed(range(steps)):
        further = offset + (1 << k)
        offset = torch.where((further < length) & _below(differ(i + further * d), of_all), further, offset)
    split = i + offset * d + torch.minimum(d, torch.zeros_like(d))
    return torch.minimum(i, end), torch.maximum(i, end), split


def _range_boxes(low: Tensor, high: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Return the boxes of the leaves ``first..last``, by a sparse table: two overlapping powers of two cover any range."""
    count = last - first + 1
    out_low, out_high = torch.empty_like(low[:, : len(first)]), torch.empty_like(high[:, : len(first)])
    width = 1
    while True:  # low, high: boxes of `width` leaves from each leaf on
        nodes = torch.nonzero((count >= width) & (count < 2 * width))[:, 0]
        a, b = first[nodes], last[nodes] - (width - 1)
        out_low[:, nodes] = torch.minimum(low[:, a], low[:, b])
        out_high[:, nodes] = torch.maximum(high[:, a], high[:, b])
        if 2 * width > low.shape[1] + width:
            return out_low, out_high
        low = torch.minimum(low[:, :-width], low[:, width:])
        high = torch.maximum(high[:, :-width], high[:, width:])
        width *= 2


def _depth(parent: Tensor) -> int:
    """Return the number of nodes on the longest chain of parents, by pointer jumping; the root is its own parent."""
    steps = (parent != torch.arange(len(parent), device=parent.device)).long()
    steps[0] = 0
    while bool((parent != 0).any()):
        steps, parent = steps + steps[parent], parent[parent]
    return int(steps.max()) + 1


# ---- Traversal by all lanes in lockstep
#
# In a step either the lanes at inner nodes descend, or the lanes at leaves test their primitives; the others wait. A step
# computes on all lanes of a chunk, and masks keep the state of those that it is not for: to choose them, the host would have
# to wait for the device. It asks once a round, after eight steps, which lanes are left, and drops the others from the state.


#: Lanes that are traversed together; bounds memory to about 100 MB.
CHUNK = 1 << 18
#: Steps of a round that descend before each of its steps that test leaves: eight steps a round.
DESCENTS = (3, 3)
#: Node of a lane that is finished, beyond all others.
_DONE = 1 << 30
#: Boxes are enlarged by 16 ulps of the distance; the slab test errs by 3 (Ize, "Robust BVH Ray Traversal", 2013).
_SLACK = 1.0 + 2.0**-20


def intersect(
    o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the nearest hits.

    Args:
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        t_max: ends of the rays ``(N,)``.
        tensors: ``corners`` and ``rows`` of the primitives and ``quadrics``, as :func:`torchpt.search.leaf.distances` takes
            them; children, boxes and order of the :class:`RadixTree`.
        counts: numbers of primitives of each kind.
        depth: of the tree.
    """
    chunks = [_Chunk(*rays, tensors, counts, depth).run(any_hit=False) for rays in _chunks(o, d, t_max)]
    t, prim, u, v = (torch.cat(x) for x in zip(*chunks, strict=True)) if len(chunks) > 1 else chunks[0]
    missed = prim < 0
    return torch.where(missed, torch.inf, t), prim.int(), torch.where(missed, 0.0, u), torch.where(missed, 0.0, v)


def occluded(o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int) -> Tensor:
    """Return True where a ray hits anything; arguments as for :func:`intersect`."""
    chunks = [_Chunk(*rays, tensors, counts, depth).run(any_hit=True)[1] for rays in _chunks(o, d, t_max)]
    return torch.cat(chunks) >= 0


def _chunks(o: Tensor, d: Tensor, t_max: Tensor) -> Iterable[tuple[Tensor, Tensor, Tensor]]:
    """Yield the rays in chunks."""
    return zip(o.split(CHUNK, 1), d.split(CHUNK, 1), t_max.split(CHUNK), strict=True)


class _Chunk:
    """The traversal of a chunk of N rays: hits of all, and the state of the n lanes that are not finished."""

    def __init__(
        self, o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int
    ) -> None:
        self.corners, self.rows, self.quadrics, self.children, self.boxes, self.order = tensors
        self.counts = counts
        self.rays = prepare_rays(o, d)
        self.t = t_max.clone()
        self.prim = torch.full_like(t_max, -1, dtype=torch.int64)
        self.u, self.v = torch.zeros_like(t_max), torch.zeros_like(t_max)
        valid = (t_max > 0) & torch.isfinite(o).all(0) & torch.isfinite(d).all(0) & (d != 0).any(0)
        self.node = torch.where(valid, 0, _DONE)
        self.top = torch.zeros_like(self.node)  # number of entries on the stack
        # Row 0 holds `_DONE`; a lane that waits at the deepest leaf writes a row above its `depth` entries.
        self.stack = torch.full((depth + 2, len(t_max)), _DONE, dtype=torch.int32, device=o.device)
        self.lanes: Tensor | None = None  # (n,) indices of the lanes in the chunk; None: all
        self.hits_of_all: tuple[Tensor, ...] = ()  # t, prim, u, v of all rays of the chunk, once stored

    def _hits(self) -> tuple[Tensor, ...]:
        return self.t, self.prim, self.u, self.v

    def run(self, any_hit: bool) -> tuple[Tensor, ...]:
        """Traverse to the end; return ``t, prim, u, v`` of all rays, where a miss has prim -1."""
        while self.children.shape[1]:  # 0 in a tree without primitives
            for descents in DESCENTS:
                for _ in range(descents):
                    self._descend()
                self._test(any_hit)
            live = torch.nonzero(self.node < _DONE)[:, 0]
            if not len(live):
                break
            if 8 * len(live) < 7 * len(self.node):  # fewer than 7/8 are left
                self._compact(live)
        self._store()
        return self.hits_of_all

    def _store(self) -> None:
        """Store the hits of the lanes in those of all rays."""
        if self.lanes is None:
            self.hits_of_all = self._hits()
        else:
            for all_rays, value in zip(self.hits_of_all, self._hits(), strict=True):
                all_rays[self.lanes] = value

    def _compact(self, live: Tensor) -> None:
        """Store all hits, and go on with the lanes ``live`` alone."""
        self._store()
        self.lanes = live if self.lanes is None else self.lanes[live]
        self.rays = self.rays.take(live)
        self.t, self.prim, self.u, self.v = (x[live] for x in self._hits())
        self.node, self.top, self.stack = self.node[live], self.top[live], self.stack[:, live]

    def _descend(self) -> None:
        """Move the lanes at inner nodes: to the nearer child that the ray hits, else to the last node on the stack."""
        inner = (self.node >= 0) & (self.node < _DONE)
        node = torch.where(inner, self.node, 0)
        near, hit = _slabs(self.rays, self.boxes[:, node].view(2, 6, -1), self.t)
        first, second = self.children[:, node].unbind(0)
        both, either, swap = hit[0] & hit[1], hit[0] | hit[1], near[1] < near[0]
        top = self.top[None]
        popped = self.stack.gather(0, top)[0]
        # All lanes write the farther child above their entries; where it is no entry, the next one replaces it.
        self.stack.scatter_(0, top + 1, torch.where(swap, first, second)[None])
        child = torch.where(torch.where(both, swap, hit[1]), second, first)
        self.node = torch.where(inner, torch.where(either, child, popped), self.node)
        step = torch.where(both, 1, torch.where(either, 0, -1))
        self.top = torch.where(inner, self.top + step, self.top).clamp_(min=0)

    def _test(self, any_hit: bool) -> None:
        """Test the primitives of the lanes at leaves, and move them to the last node on the stack."""
        leaf = self.node < 0
        prim = self.order[torch.where(leaf, ~self.node, 0)].long()
        t, u, v = distances(self.rays, prim, self.corners, self.rows, self.quadrics, self.counts)
        better = leaf & (t > 0) & ((t < self.t) | ((t == self.t) & (prim < self.prim)))
        self.t, self.prim = torch.where(better, t, self.t), torch.where(better, prim, self.prim)
        self.u, self.v = torch.where(better, u, self.u), torch.where(better, v, self.v)
        self.node = torch.where(leaf, self.stack.gather(0, self.top[None])[0], self.node)
        self.top = torch.where(leaf, self.top - 1, self.top).clamp_(min=0)
        if any_hit:
            self.node = torch.where(better, _DONE, self.node)


def _slabs(ray: Rays, box: Tensor, t_max: Tensor) -> tuple[Tensor, Tensor]:
    """Return entry distances into boxes ``(2, 6, N)``, and True where they are hit before ``t_max`` (conservative)."""
    a, b = (box[:, 0:3] - ray.o) * ray.inverse, (box[:, 3:6] - ray.o) * ray.inverse
    near = torch.minimum(a, b).amax(1).clamp(min=0.0)
    far = torch.minimum(torch.maximum(a, b).amin(1), t_max) * _SLACK
    return near, near <= far


# ---- The search: the reference for the other backends


class Lbvh(Accel):
    """A linear BVH (Karras 2012) built and traversed by tensor operations.

    Args:
        geometry: the primitives, on any device.

    Attributes:
        geometry: the same, in the memory of this search.
    """

    name = "torch"

    def __init__(self, geometry: Geometry) -> None:
        start = time.perf_counter()
        tables = affine_rows(geometry)
        self.counts = list(geometry.counts)
        self.corners = torch.cat([geometry.p0, geometry.p1, geometry.p2]).float()
        p0, p1, p2 = self.corners.split(3)
        self.geometry = Geometry(p0, p1, p2, geometry.counts, geometry.quadrics, geometry.copies)
        self.rows = tables.rows.T.contiguous()
        quadrics = quadric_rows(geometry)
        # the last row, h, is left out if it is 0 in all quadrics, which saves its operations
        self.quadrics = quadrics if bool(quadrics[-1].any()) else quadrics[:-1]
        with_area = torch.nonzero(tables.area)[:, 0]
        low, high = primitive_bounds(geometry)
        self.tree = build_tree(low[:, with_area], high[:, with_area], with_area)
        self.build_seconds = time.perf_counter() - start

    def _tensors(self) -> list[Tensor]:
        """Return the tensors that :func:`intersect` takes."""
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
    """Return the SAH cost: 1 a node and 1 a primitive, for a random ray through the root's box (MacDonald and Booth 1990)."""
    if tree.children.shape[1] == 0:
        return float(tree.order.shape[0])
    boxes = tree.boxes.double()
    area = torch.stack([half_areas(boxes[0:3], boxes[3:6]), half_areas(boxes[6:9], boxes[9:12])])
    low, high = torch.minimum(boxes[0:3, :1], boxes[6:9, :1]), torch.maximum(boxes[3:6, :1], boxes[9:12, :1])
    return float(1 + area.sum() / half_areas(low, high).clamp(min=torch.finfo(torch.float64).tiny))
