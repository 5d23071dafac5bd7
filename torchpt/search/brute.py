"""Every ray against every primitive, in packets: the fastest search for a few dozen primitives on a CPU.

The code is that of compiled renders (:mod:`torchpt.compiler.packet`), as kernels of whole tensors: in a render by tensor
operations a ray meets what it meets inside of a stage, wherever in the batch it stands. Packets know planar
primitives and spheres; quadrics come afterwards, one by one (:func:`merge_quadric_hits`).
Edges are watertight because primitives accept their own rounding error (:func:`torchpt.search.tables.tolerances`).
"""

from __future__ import annotations

import ctypes
import functools
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.compiler import cache
from torchpt.compiler.function import Lanewise
from torchpt.compiler.graph import Graph
from torchpt.compiler.kernel import HEAD
from torchpt.compiler.packet import KINDS, scene_words
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import Sinks, Store
from torchpt.core.dispatch import dispatched
from torchpt.core.errors import SceneError
from torchpt.core.threads import parallel_for, thread_count
from torchpt.native import compile_time
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.leaf import quadric
from torchpt.search.tables import Tables, affine_rows, extent, quadric_rows, tolerances

__all__ = ["MAX_TOLERANCE", "Brute", "Rows", "merge_quadric_hits", "rows_of"]

#: Largest share of its own size by which a primitive may be enlarged (rays across it, from within the scene).
MAX_TOLERANCE = 1e-3
#: Rays that a thread takes together: a multiple of a packet's.
_BLOCK = 64
#: Rays times primitives that repay another thread: some 50 microseconds.
_GRAIN = 100_000
_SEARCH = HEAD.index("search")


class Rows(NamedTuple):
    """Primitives as packets read them.

    Attributes:
        tables: of them.
        size: largest coordinate of the scene.
        tolerance: ``(P,)`` float64 by which each is enlarged, see :func:`torchpt.search.tables.tolerances`.
    """

    tables: Tables
    size: float
    tolerance: Tensor

    @property
    def fine(self) -> bool:
        """Return True where float32 is fine enough for these primitives: no mixed scales, no slivers."""
        return bool((self.tolerance * self.size <= MAX_TOLERANCE).all())


def rows_of(geometry: Geometry) -> Rows:
    """Return the rows of primitives; whether they are fine enough is for the caller to ask."""
    size, tables = extent(geometry), affine_rows(geometry)
    return Rows(tables, size, tolerances(tables.rows64, size))


class Brute(Accel):
    """Brute force over packets of rays (kernels of the lane compiler, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; ``None`` is torch's number, as it is when rays are searched.
        rows: of the primitives, where they are known already.

    Attributes:
        words: what kernels read of the primitives, see :func:`torchpt.compiler.packet.scene_words`.

    Raises:
        SceneError: the geometry is not on the CPU, or float32 rows are too coarse for it.
    """

    name = "brute"

    def __init__(self, geometry: Geometry, threads: int | None = None, rows: Rows | None = None) -> None:
        start = time.perf_counter()
        if geometry.p0.device.type != "cpu":
            raise SceneError("render.accel", "brute", "torch (brute runs on the CPU only)")
        tables, size, tolerance = rows = rows_of(geometry) if rows is None else rows
        if not rows.fine:
            raise SceneError("render.accel", "brute", "numba or torch (this scene's scales are too mixed for brute)")
        planar, round_ = sum(geometry.counts[:3]), sum(geometry.counts[:4])
        table = torch.cat([tables.rows64, tolerance[:, None]], 1)[:planar]
        self.table = table.float().contiguous()
        balls = torch.cat([geometry.p0, geometry.p1[:1]])[:, planar:round_].T.double()
        self.spheres = torch.where(tables.area[planar:round_, None], balls, torch.nan).contiguous()
        columns = quadric_rows(geometry).T.contiguous()
        self.quadrics = [(row, torch.tensor(round_ + k, dtype=torch.int32)) for k, row in enumerate(columns)]
        self.counts = list(geometry.counts)
        self.kinds = tuple(kind for kind, some in zip(KINDS, self.counts, strict=False) if some)
        self.threads = threads
        self.words = scene_words(self.table, self.spheres, self.counts, size)
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        t, u, v = (torch.empty_like(t_max) for _ in range(3))
        prim = torch.empty_like(t_max, dtype=torch.int32)
        self._search(False, (o, d, t_max), (t, prim, u, v))
        for row, number in self.quadrics:
            t, prim, u, v = merge_quadric_hits(o, d, t_max, t, prim, u, v, row, number)
        return t, prim, u, v

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        if self.quadrics:
            return self._intersect(o, d, t_max)[1] >= 0
        blocked = torch.empty_like(t_max, dtype=torch.bool)
        self._search(True, (o, d, t_max), (blocked,))
        return blocked

    def _search(self, any_hit: bool, rays: Sequence[Tensor], results: Sequence[Tensor]) -> None:
        """Search planar primitives and spheres, over as many threads as repay."""
        call, count = _kernel(self.kinds, any_hit), results[0].shape[0]
        rows = [(x.data_ptr(), x.element_size()) for x in (*rays, *results)]

        def part(first: int, last: int) -> None:
            start, end = first * _BLOCK, min(last * _BLOCK, count)
            head = [0] * len(HEAD)
            head[_SEARCH] = ctypes.addressof(self.words)
            for address, size in rows:
                head += (address + start * size, count)
            block = (ctypes.c_int64 * len(head))(*head)
            call(ctypes.addressof(block), end - start)

        most = max(count * sum(self.counts) // _GRAIN, 1)
        # In threads of the pool torch has but one: loops that search there share the work already.
        threads = min(thread_count(self.threads), torch.get_num_threads(), most)
        parallel_for(part, -(-count // _BLOCK), threads)

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
            "bytes": self.table.nbytes + self.spheres.nbytes + sum(row.nbytes for row, _ in self.quadrics),
            "build_seconds": self.build_seconds,
        }


@functools.cache
def _kernel(kinds: tuple[str, ...], any_hit: bool) -> Any:
    """Return the search among kinds of primitives as a kernel of rays ``o, d, t_max`` and of results."""
    graph = Graph()
    ray = [graph.node("tensor", "f", extra=(slot, k)) for slot, rows in enumerate((3, 3, 1)) for k in range(rows)]
    if any_hit:
        stores = [Store((graph.node("occluded", "b", *ray),), "b")]
    else:
        hits = graph.node("nearest", "S", *ray)
        stores = [Store((graph.node("part", ty, hits, extra=k),), ty) for k, ty in enumerate("fiff")]
    compile_time.begin()
    try:
        return cache.compiled(TracedStage(graph, Sinks(store=stores), tensors=3, searched=kinds)).call
    finally:
        compile_time.end()


@dispatched
def merge_quadric_hits(
    o: Tensor, d: Tensor, t_max: Tensor, t: Tensor, prim: Tensor, u: Tensor, v: Tensor, row: Tensor, number: Tensor
) -> Hits:
    """Return hits, those on one quadric where it is nearer: its ``row (19,)`` and its id."""
    sound = torch.isfinite(o).all(0) & torch.isfinite(d).all(0)
    at, a, b = quadric(o, d, row[:, None])
    hit = sound & (at > 0) & (at < torch.minimum(t, t_max))
    return torch.where(hit, at, t), torch.where(hit, number, prim), torch.where(hit, a, u), torch.where(hit, b, v)


merge_quadric_hits.register(
    Lanewise(merge_quadric_hits.function, ("o", "d", "t_max", "t", "prim", "u", "v"), ("row", "number"))
)
