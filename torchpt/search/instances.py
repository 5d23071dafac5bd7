"""Instances of meshes as a second level of search, by tensor operations.

An *instance* (in code and tables also *copy*) is a mesh of the scene under an affine map. I is the number of instances.
"""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.bounds import primitive_bounds

__all__ = ["CopyTables", "Instanced", "bounding_sphere"]


# ---- Two levels: first the primitives, then the instances
#
# A ray is transformed to the mesh's own space by the inverse of the instance's transform, in float64; its direction is not
# normalized, so ``t`` is the same in both spaces. All instances of a mesh share one tree.


#: Most pairs of a ray and an instance that are tested together; bounds memory to about 100 MB.
PAIRS = 1 << 22
#: Relative enlargement of the boxes of instances, for the rounding of rays that are transformed to the mesh's space.
MARGIN = 2.0**-20


class CopyTables:
    """Tables of the instances, for both searches, by tensor operations and by trees of kernels.

    Attributes:
        meshes: the geometry of each distinct mesh.
        mesh: ``(I,)`` int64, the mesh of each instance.
        shift: ``(I,)`` int64, added to a triangle's index in its mesh to get its primitive id in the instance.
        inverse: ``(I, 12)`` float64 rows of the transform from the world to the mesh's own space.
        low: ``(3, I)`` float32 boxes in the world.
        high: ``(3, I)`` float32.
    """

    def __init__(self, geometry: Geometry) -> None:
        assert geometry.copies is not None
        first, count, first_id = (row.to(torch.int64) for row in geometry.copies[12:15])
        # instances of one mesh have the same triangles
        spans, self.mesh = torch.unique(torch.stack((first, count)), dim=1, return_inverse=True)
        self.meshes = [_triangles(geometry, int(start), int(size)) for start, size in spans.T]
        self.shift = first_id
        maps = geometry.copies[:12].T.reshape(-1, 3, 4)
        linear = torch.linalg.inv(maps[:, :, :3])
        self.inverse = torch.cat([linear, -(linear @ maps[:, :, 3:])], 2).reshape(-1, 12).contiguous()
        boxes = []
        for mesh in self.meshes:
            low, high = primitive_bounds(mesh)
            origin = torch.zeros(3, device=low.device)
            boxes.append(torch.stack((low.amin(1), high.amax(1)) if mesh.size else (origin, origin)).double())
        box = torch.stack(boxes)[self.mesh]  # (I, 2, 3)
        # The box in the world: its centre is mapped, its half sizes by the absolute values of the linear map.
        middle, half = 0.5 * (box[:, 0] + box[:, 1]), 0.5 * (box[:, 1] - box[:, 0])
        middle = (maps[:, :, :3] @ middle[:, :, None] + maps[:, :, 3:])[:, :, 0]
        half = (maps[:, :, :3].abs() @ half[:, :, None])[:, :, 0]
        half = half + MARGIN * (middle.abs() + half)
        self.low, self.high = ((middle + sign * half).float().T.contiguous() for sign in (-1, 1))


def _triangles(geometry: Geometry, first: int, count: int) -> Geometry:
    """Return ``count`` triangles of a geometry, from the id ``first`` on."""
    columns = slice(first, first + count)
    return Geometry(geometry.p0[:, columns], geometry.p1[:, columns], geometry.p2[:, columns], (count, 0, 0, 0, 0))


def bounding_sphere(geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Return centre ``(3,)`` and radius ``()`` of a sphere around all surfaces, instances included; float64.

    Without surfaces it is the unit sphere.
    """
    boxes = [primitive_bounds(geometry)]
    if geometry.copies is not None:
        tables = CopyTables(geometry)
        boxes.append((tables.low, tables.high))
    low, high = (torch.cat(sides, 1).double() for sides in zip(*boxes, strict=True))
    if not low.shape[1]:
        return low.new_zeros(3), low.new_ones(())
    low, high = low.amin(1), high.amax(1)
    return 0.5 * (low + high), 0.5 * (high - low).norm()


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
        self.primitives = int(geometry.size + geometry.copies[13].sum())  # row 13: triangles of each instance
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        best = self.base._intersect(o, d, t_max)
        t, *_ = best
        for lanes, mesh, copy in self._pairs(o, d, torch.minimum(t, t_max)):
            hits = self.trees[mesh]._intersect(*self._to_mesh_space(o, d, lanes, copy), t_max[lanes])
            best = _nearer(best, lanes, hits, self.tables.shift[copy])
        return best

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        blocked = self.base._occluded(o, d, t_max)
        for lanes, mesh, copy in self._pairs(o, d, torch.where(blocked, 0.0, t_max)):
            hit = self.trees[mesh]._occluded(*self._to_mesh_space(o, d, lanes, copy), t_max[lanes])
            blocked |= torch.zeros_like(blocked, dtype=torch.int32).index_add_(0, lanes, hit.int()) > 0
        return blocked

    def _pairs(self, o: Tensor, d: Tensor, reach: Tensor) -> list[tuple[Tensor, int, Tensor]]:
        """Return pairs of a ray and an instance whose box it hits before ``reach`` ``(N,)``, grouped by mesh.

        Returns:
            For each group: the rays ``(K,)`` int64, the index of the mesh, and the instances ``(K,)`` int64.
        """
        from torchpt.search.leaf import prepare_rays

        valid = (reach > 0) & torch.isfinite(o).all(0) & torch.isfinite(d).all(0) & (d != 0).any(0)
        live = torch.nonzero(valid)[:, 0]
        groups: list[tuple[Tensor, int, Tensor]] = []
        copies = self.tables.mesh.shape[0]
        for lanes in live.split(max(1, PAIRS // copies)):
            if not lanes.numel():
                continue
            rays = prepare_rays(o[:, lanes], d[:, lanes])
            # slab test of all rays of the split with all instances, (rays, I)
            near, far = torch.zeros_like(reach[lanes])[:, None], reach[lanes][:, None]
            for axis in range(3):
                at_low, at_high = (
                    (box[axis] - rays.o[axis][:, None]) * rays.inverse[axis][:, None]
                    for box in (self.tables.low, self.tables.high)
                )
                near = torch.maximum(near, torch.minimum(at_low, at_high))
                far = torch.minimum(far, torch.maximum(at_low, at_high))
            lane, copy = torch.nonzero(near <= far * (1.0 + MARGIN), as_tuple=True)
            if len(self.trees) > 1:
                mesh_of_pair, order = torch.sort(self.tables.mesh[copy], stable=True)
                # the number of pairs of each mesh: all that the host has to wait for
                mesh = torch.arange(len(self.trees), device=copy.device)
                sizes = (mesh_of_pair == mesh[:, None]).sum(1).tolist()
                pairs = zip(lane[order].split(sizes), copy[order].split(sizes), strict=True)
            else:
                pairs = ((lane, copy),)
            groups += [(lanes[rays_of_mesh], mesh, on) for mesh, (rays_of_mesh, on) in enumerate(pairs) if len(on)]
        return groups

    def _to_mesh_space(self, o: Tensor, d: Tensor, lanes: Tensor, copy: Tensor) -> tuple[Tensor, Tensor]:
        """Return origins and directions of the rays ``lanes`` in the space of the meshes of the instances ``copy``."""
        rows = self.tables.inverse[copy].T
        px, py, pz = o[:, lanes].double().unbind(0)
        rx, ry, rz = d[:, lanes].double().unbind(0)
        first_columns = (0, 4, 8)  # of the rows of x, y and z: three factors and a constant each
        origin = [rows[k] * px + rows[k + 1] * py + rows[k + 2] * pz + rows[k + 3] for k in first_columns]
        direction = [rows[k] * rx + rows[k + 1] * ry + rows[k + 2] * rz for k in first_columns]
        return torch.stack(origin).float(), torch.stack(direction).float()

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; nodes, leaves and bytes count each mesh once, the cost leaves instances out."""
        base = self.base.describe()
        levels = [base, *(tree.describe() for tree in self.trees)]
        return base | {
            "primitives": self.primitives,
            "instances": self.tables.mesh.shape[0],
            **{key: sum(level[key] for level in levels) for key in ("nodes", "leaves", "bytes")},
            "depth": max(level["depth"] for level in levels),
            "build_seconds": base["build_seconds"] + self.build_seconds,
        }


def _nearer(best: Hits, lanes: Tensor, hits: Hits, shift: Tensor) -> Hits:
    """Merge hits of pairs into the nearest hits of the rays; of equal ``t`` the lowest id wins.

    Args:
        best: the nearest hits so far, of N rays.
        lanes: ``(K,)`` the ray of each pair.
        hits: K hits, with ids within the mesh.
        shift: ``(K,)``, added to these ids.
    """
    t, prim, u, v = best
    new_t, new_prim, new_u, new_v = hits
    least = t.scatter_reduce(0, lanes, new_t, "amin")
    no_id = torch.iinfo(torch.int64).max
    new_id = torch.where((new_prim >= 0) & (new_t == least[lanes]), new_prim.long() + shift, no_id)
    # A hit of the other primitives at the same distance stays: its id is lower.
    old_id = torch.where((prim >= 0) & (t == least), prim.long(), no_id)
    lowest = old_id.scatter_reduce(0, lanes, new_id, "amin")
    won = torch.nonzero((new_id == lowest[lanes]) & (new_id < no_id))[:, 0]
    lanes = lanes[won]
    t, prim, u, v = t.clone(), prim.clone(), u.clone(), v.clone()
    t[lanes], prim[lanes], u[lanes], v[lanes] = new_t[won], new_id[won].int(), new_u[won], new_v[won]
    return t, prim, u, v
