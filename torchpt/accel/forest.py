"""The search structures of several scenes: each ray is searched for in its own scene.

By tensor operations all rays travel at once, each from the root of its tree; other structures are asked one after another.
Either way a ray meets what it meets alone, to the bit: primitives, boxes and their order are those of its scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate

import torch
from torch import Tensor

from torchpt.accel import traverse
from torchpt.accel.base import Accel, Hits, as_rays
from torchpt.accel.lbvh import Lbvh
from torchpt.accel.numbers import Numbers
from torchpt.math.vectors import take

__all__ = ["Forest"]


class Forest:
    """Structures of S scenes.

    Args:
        accels: of the scenes, on one device.
        numbers: of their primitives.
    """

    def __init__(self, accels: Sequence[Accel], numbers: Numbers) -> None:
        self._accels, self._numbers = accels, numbers
        trees = [accel for accel in accels if isinstance(accel, Lbvh)]
        # In some scenes quadrics may be told by fewer numbers than in others.
        joins = len(trees) == len(accels) and len({len(tree.quadrics) for tree in trees}) == 1
        self._nodes = _nodes_of(trees, numbers) if joins else None
        self._roots = _roots_of(trees, numbers.of.device)

    @torch.no_grad()
    def intersect(self, o: Tensor, d: Tensor, t_max: Tensor, scene: Tensor) -> Hits:
        """As :meth:`Accel.intersect`, in scenes ``(N,)`` int64; ``prim``, of any integers, counts among all."""
        if self._nodes is not None:
            return traverse.intersect(*as_rays(o, d, t_max), self._nodes, take(self._roots, scene))
        t = torch.full_like(t_max, torch.inf, dtype=torch.float32)
        # Of copies in many scenes there may be more primitives than int32 counts.
        hits = t, torch.full_like(t, -1, dtype=torch.int64), torch.zeros_like(t), torch.zeros_like(t)

        def search(number: int, lanes: Tensor) -> None:
            t, prim, u, v = self._accels[number].intersect(take(o, lanes), take(d, lanes), take(t_max, lanes))
            for whole, part in zip(hits, (t, self._numbers.among_all(number, prim.long()), u, v), strict=True):
                whole[lanes] = part

        self._each(scene, search)
        return hits

    @torch.no_grad()
    def occluded(self, o: Tensor, d: Tensor, t_max: Tensor, scene: Tensor) -> Tensor:
        """As :meth:`Accel.occluded`, in scenes ``(N,)`` int64."""
        if self._nodes is not None:
            return traverse.occluded(*as_rays(o, d, t_max), self._nodes, take(self._roots, scene))
        blocked = torch.zeros_like(t_max, dtype=torch.bool)

        def search(number: int, lanes: Tensor) -> None:
            blocked[lanes] = self._accels[number].occluded(take(o, lanes), take(d, lanes), take(t_max, lanes))

        self._each(scene, search)
        return blocked

    def _each(self, scene: Tensor, search: Callable[[int, Tensor], None]) -> None:
        """Search the lanes of each scene."""
        order = torch.argsort(scene, stable=True)
        counts = torch.bincount(scene, minlength=len(self._accels)).tolist()
        for number, lanes in enumerate(order.split(counts)):
            if len(lanes):
                search(number, lanes)


def _roots_of(accels: Sequence[Lbvh], device: torch.device) -> Tensor:
    """The first node of each tree ``(S,)``, all trees one after another."""
    sizes = [accel.tree.children.shape[1] for accel in accels]
    firsts = [
        first if size else traverse.NONE for first, size in zip(accumulate(sizes, initial=0), sizes, strict=False)
    ]
    return torch.tensor(firsts, dtype=torch.int64, device=device)


def _nodes_of(accels: Sequence[Lbvh], numbers: Numbers) -> traverse.Nodes:
    """The trees of all scenes."""
    children, order = [], []
    nodes = leaves = 0
    for number, accel in enumerate(accels):
        tree = accel.tree
        children.append(torch.where(tree.children < 0, tree.children - leaves, tree.children + nodes))
        order.append(take(numbers.own(number), tree.order.long()).int())
        nodes, leaves = nodes + tree.children.shape[1], leaves + tree.order.shape[0]
    tensors = [
        numbers.primitives([accel.corners for accel in accels]),
        numbers.primitives([accel.rows for accel in accels]),
        torch.cat([accel.quadrics for accel in accels], 1),
        torch.cat(children, 1),
        torch.cat([accel.tree.boxes for accel in accels], 1),
        torch.cat(order),
    ]
    return traverse.Nodes(tensors, list(numbers.counts), max(accel.tree.depth for accel in accels))
