"""Every ray against every primitive, in blocks of 64 rays: the fastest search for a few dozen primitives on a CPU.

One primitive's numbers are broadcast over a block of rays, so the inner loop has a constant trip count and no branches
and becomes vector code. A last, shorter block is padded: a ray's result does not depend on its place in the batch.
The kernels are imported when a ray is traced: scenes of few primitives are searched by the compiled loop itself.
Edges are watertight because primitives accept their own rounding error (:func:`torchpt.accel.tables.tolerances`).
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.accel.base import Accel, Array, Hits, closer
from torchpt.accel.tables import extent, inverses, prepare, tolerances
from torchpt.core.threads import thread_count
from torchpt.errors import SceneError
from torchpt.records import Geometry

__all__ = ["MAX_TOLERANCE", "Brute", "eligible"]

#: Largest share of its own size by which a primitive may be enlarged (rays across it, from within the scene).
MAX_TOLERANCE = 1e-3
_GRAIN = 16  # blocks of 64 rays that repay another thread


def eligible(geometry: Geometry) -> bool:
    """Whether float32 rows are fine enough for these primitives (no mixed scales, no slivers)."""
    size = extent(geometry)
    return bool((tolerances(prepare(geometry).rows64, size) * size <= MAX_TOLERANCE).all())


class Brute(Accel):
    """Brute force over blocks of rays (numba, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.

    Raises:
        SceneError: the geometry is not on the CPU, or float32 rows are too coarse for it.
    """

    name = "brute"

    def __init__(self, geometry: Geometry, threads: int | None = None) -> None:
        start = time.perf_counter()
        if geometry.p0.device.type != "cpu":
            raise SceneError("render.accel", "brute", "torch (brute runs on the CPU only)")
        if not eligible(geometry):
            raise SceneError("render.accel", "brute", "numba or torch (this scene's scales are too mixed for brute)")
        size, tables = extent(geometry), prepare(geometry)
        planar, round_ = sum(geometry.counts[:3]), sum(geometry.counts[:4])
        table = torch.cat([tables.rows64, tolerances(tables.rows64, size)[:, None]], 1)[:planar]
        self.table = table.float().contiguous()
        balls = torch.cat([geometry.p0, geometry.p1[:1]])[:, planar:round_].T.double()
        self.spheres = torch.where(tables.area[planar:round_, None], balls, torch.nan).contiguous()
        self.quadrics = inverses(geometry).T.contiguous()
        self.counts = list(geometry.counts)
        self.extent = size
        self.threads = threads
        self.arrays = (
            *(x.numpy() for x in (self.table, self.spheres, self.quadrics)),
            *self.counts[:3],
            np.float32(size),
        )
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        from torchpt.accel import kernels_brute as kernels

        t, u, v = (torch.empty_like(t_max) for _ in range(3))
        prim = torch.empty_like(t_max, dtype=torch.int32)
        self._launch(kernels.intersect, kernels.intersect_parallel, o, d, t_max, t, prim, u, v)
        return t, prim, u, v

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        from torchpt.accel import kernels_brute as kernels

        blocked = torch.empty_like(t_max, dtype=torch.bool)
        self._launch(kernels.occluded, kernels.occluded_parallel, o, d, t_max, blocked)
        return blocked

    def _launch(self, serial: Any, parallel: Any, o: Tensor, d: Tensor, t_max: Tensor, *results: Tensor) -> None:
        """Run a kernel on rays, over as many threads as repay."""
        from torchpt.accel import kernels_brute as kernels
        from torchpt.native.jit import launch

        rays = (x.contiguous().numpy() for x in (o, d, t_max))
        args = (*rays, *self.arrays, *(x.numpy() for x in results))
        blocks = -(-t_max.shape[0] // kernels.BLOCK)
        launch(serial, parallel, blocks, thread_count(self.threads), _GRAIN, args)

    def nearest(self, o: Array, d: Array, t_max: Array, count: int, t: Array, prim: Array, u: Array, v: Array) -> None:
        """See :meth:`Accel.nearest`."""
        from torchpt.accel import kernels_brute as kernels

        blocks = -(-count // kernels.BLOCK)
        results = (t[:count], prim[:count], u[:count], v[:count])
        kernels.intersect(0, blocks, o, d, t_max[:count], *self.arrays, *results)

    def blocked(
        self, o: Array, d: Array, t_max: Array, count: int, out: Array, non_opaque: Array | None = None
    ) -> None:
        """See :meth:`Accel.blocked`."""
        from torchpt.accel import kernels_brute as kernels

        kernels.occluded(0, -(-count // kernels.BLOCK), o, d, t_max[:count], *self.arrays, out[:count])
        closer(out[:count], non_opaque)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; there are no nodes, and the cost is one test a primitive."""
        primitives = sum(self.counts)
        return {
            "name": self.name,
            "primitives": primitives,
            "nodes": 0,
            "leaves": 0,
            "sah_cost": float(primitives),
            "depth": 0,
            "bytes": self.table.nbytes + self.spheres.nbytes + self.quadrics.nbytes,
            "build_seconds": self.build_seconds,
        }
