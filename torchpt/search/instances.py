"""Instances of meshes as a second level of search, by tensor operations."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.bounds import primitive_bounds

__all__ = ["CopyTables", "Instanced"]


# ---- Two levels: first the primitives, then the instances
#
# A ray is transformed to the mesh's own space by the inverse of the instance's transform, in float64; its direction is not
# normalized, so ``t`` is the same in both spaces. All instances of a mesh share one tree.


#: Most pairs of a ray and an instance that are tested together.
PAIRS = 1 << 22
#: Relative enlargement of the boxes of instances, for the rounding of rays that are transformed to the mesh's space.
MARGIN = 2.0**-20


class CopyTables:
    """Tables of the instances, for both searches, by tensor operations and by trees of kernels.

    Attributes:
        meshes: the geometry of each distinct mesh.
        mesh: ``(I,)`` int64, the mesh of each instance.
        shift: ``(I,)`` int64, added to a triangle's number in its mesh to get its id in the instance.
        inverse: ``(I, 12)`` float64 rows of the transform from the world to the mesh's own space.
        low: ``(3, I)`` float32 boxes in the world.
        high: ``(3, I)`` float32.
    """

    def __init__(self, geometry: Geometry) -> None:
        assert geometry.copies is not None
        first, count, start = (row.to(torch.int64) for row in geometry.copies[12:15])
        spans, self.mesh = torch.unique(torch.stack((first, count)), dim=1, return_inverse=True)
        self.meshes = [_span(geometry, int(a), int(n)) for a, n in spans.T]
        self.shift = start
        maps = geometry.copies[:12].T.reshape(-1, 3, 4)
        linear = torch.linalg.inv(maps[:, :, :3])
        self.inverse = torch.cat([linear, -(linear @ maps[:, :, 3:])], 2).reshape(-1, 12).contiguous()
        boxes = []
        for mesh in self.meshes:
            low, high = primitive_bounds(mesh)
            empty = torch.zeros(3, device=low.device)
            boxes.append(torch.stack((low.amin(1), high.amax(1)) if mesh.size else (empty, empty)).double())
        box = torch.stack(boxes)[self.mesh]  # (I, 2, 3)
        middle, half = 0.5 * (box[:, 0] + box[:, 1]), 0.5 * (box[:, 1] - box[:, 0])
        middle = (maps[:, :, :3] @ middle[:, :, None] + maps[:, :, 3:])[:, :, 0]
        half = (maps[:, :, :3].abs() @ half[:, :, None])[:, :, 0]
        half = half + MARGIN * (middle.abs() + half)
        self.low, self.high = ((middle + s * half).float().T.contiguous() for s in (-1, 1))


def _span(geometry: Geometry, first: int, count: int) -> Geometry:
    rows = slice(first, first + count)
    return Geometry(geometry.p0[:, rows], geometry.p1[:, rows], geometry.p2[:, rows], (count, 0, 0, 0, 0))


class Instanced(Accel):
    """A search over the primitives, extended to instances by tensor operations: the reference.

    Args:
        geometry: the primitives, with instances.
        base: the search over the primitives that belong to no instance.
    """

    def __init__(self, geometry: Geometry, base: Accel) -> None:
        from torchpt.search.lbvh import Lbvh

        start = time.perf_counter()
        self.name, self.base, self.tables = base.name, base, CopyTables(geometry)
        self.trees: list[Accel] = [Lbvh(mesh) for mesh in self.tables.meshes]
        assert geometry.copies is not None
        self.ids = int(geometry.size + geometry.copies[13].sum())
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        best = self.base._intersect(o, d, t_max)
        for lanes, mesh, copy in self._pairs(o, d, torch.minimum(best[0], t_max)):
            found = self.trees[mesh]._intersect(*self._moved(o, d, lanes, copy), t_max[lanes])
            best = _nearer(best, lanes, found, self.tables.shift[copy])
        return best

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        blocked = self.base._occluded(o, d, t_max)
        for lanes, mesh, copy in self._pairs(o, d, torch.where(blocked, 0.0, t_max)):
            met = self.trees[mesh]._occluded(*self._moved(o, d, lanes, copy), t_max[lanes])
            blocked[lanes[met]] = True
        return blocked

    def _pairs(self, o: Tensor, d: Tensor, reach: Tensor) -> list[tuple[Tensor, int, Tensor]]:
        """Return pairs of a ray and an instance whose box it hits before ``reach``, by mesh: lanes, mesh, instances."""
        from torchpt.search.leaf import prepare_rays

        good = (reach > 0) & torch.isfinite(o).all(0) & torch.isfinite(d).all(0) & (d != 0).any(0)
        live = torch.nonzero(good)[:, 0]
        found: list[tuple[Tensor, int, Tensor]] = []
        copies = self.tables.mesh.shape[0]
        for lanes in live.split(max(1, PAIRS // copies)):
            if not lanes.numel():
                continue
            rays = prepare_rays(o[:, lanes], d[:, lanes])
            near, far = torch.zeros_like(reach[lanes])[:, None], reach[lanes][:, None]
            for axis in range(3):
                a, b = (
                    (box[axis] - rays.o[axis][:, None]) * rays.inverse[axis][:, None]
                    for box in (self.tables.low, self.tables.high)
                )
                near, far = torch.maximum(near, torch.minimum(a, b)), torch.minimum(far, torch.maximum(a, b))
            lane, copy = torch.nonzero(near <= far * (1.0 + 2.0**-20), as_tuple=True)
            kinds = self.tables.mesh[copy]
            for mesh in range(len(self.trees)):
                which = kinds == mesh
                if len(self.trees) == 1 or bool(which.any()):
                    found.append((lanes[lane[which]], mesh, copy[which]))
        return found

    def _moved(self, o: Tensor, d: Tensor, lanes: Tensor, copy: Tensor) -> tuple[Tensor, Tensor]:
        rows = self.tables.inverse[copy].T
        px, py, pz = o[:, lanes].double().unbind(0)
        rx, ry, rz = d[:, lanes].double().unbind(0)
        at = [rows[k] * px + rows[k + 1] * py + rows[k + 2] * pz + rows[k + 3] for k in (0, 4, 8)]
        along = [rows[k] * rx + rows[k + 1] * ry + rows[k + 2] * rz for k in (0, 4, 8)]
        return torch.stack(at).float(), torch.stack(along).float()

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; nodes, leaves and bytes count each mesh once, the cost leaves instances out."""
        parts = [self.base.describe(), *(tree.describe() for tree in self.trees)]
        return parts[0] | {
            "primitives": self.ids,
            "instances": self.tables.mesh.shape[0],
            **{key: sum(part[key] for part in parts) for key in ("nodes", "leaves", "bytes")},
            "depth": max(part["depth"] for part in parts),
            "build_seconds": parts[0]["build_seconds"] + self.build_seconds,
        }


def _nearer(best: Hits, lanes: Tensor, found: Hits, shift: Tensor) -> Hits:
    """Merge hits of pairs into the nearest hits of the rays; of equal ``t`` the lowest id wins."""
    t, prim, u, v = best
    hit = found[1] >= 0
    lanes, near, id_ = lanes[hit], found[0][hit], found[1][hit].long() + shift[hit]
    least = t.scatter_reduce(0, lanes, near, "amin")
    first = near == least[lanes]
    lanes, near, id_, a, b = lanes[first], near[first], id_[first], found[2][hit][first], found[3][hit][first]
    # An earlier hit at the same distance stays: its id is lower.
    none = torch.iinfo(torch.int64).max
    before = torch.where((prim >= 0) & (t == least), prim.long(), none)
    lowest = before.scatter_reduce(0, lanes, id_, "amin")
    won = id_ == lowest[lanes]
    lanes = lanes[won]
    t, prim, u, v = t.clone(), prim.clone(), u.clone(), v.clone()
    t[lanes], prim[lanes], u[lanes], v[lanes] = near[won], id_[won].int(), a[won], b[won]
    return t, prim, u, v
