"""The radix tree over Morton codes, by tensor operations without a loop over primitives.

Karras, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees", HPG 2012.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Tree", "build_tree", "morton_codes"]

_BITS = 21


class Tree(NamedTuple):
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


def build_tree(low: Tensor, high: Tensor, ids: Tensor) -> Tree:
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
        return Tree(torch.full((2, min(n, 1)), -1, dtype=torch.int32, device=device), boxes, ids.int(), min(n, 1))
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
    return Tree(children, boxes.contiguous(), order, _depth(parent))


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
