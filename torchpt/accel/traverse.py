"""Traversal of the radix tree by a whole wave: each step moves every live lane by one node."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.accel.leaf import Rays, distances, prepare_rays

__all__ = ["intersect", "occluded"]

#: Lanes that travel together; bounds memory to some 100 MB.
CHUNK = 1 << 18
_DONE = 1 << 30
#: Boxes are enlarged by 16 ulps of the distance: the slabs' own error is 3 (Ize, "Robust BVH Ray Traversal", 2013).
_SLACK = 1.0 + 2.0**-20


def intersect(
    o: Tensor, d: Tensor, t_max: Tensor, tensors: list[Tensor], counts: list[int], depth: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Nearest hits; arguments as :class:`torchpt.accel.lbvh.Lbvh` holds them."""
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
