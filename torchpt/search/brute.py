"""Brute-force intersection in packets of rays: the fastest search for a few dozen primitives on a CPU.

The kernels have the code that compiled stages contain (:mod:`torchpt.compiler.packet`), so the hits have the same bits in a
render by tensor operations. They know planar primitives and spheres; quadrics are tested afterwards, one by one
(:func:`merge_quadric_hits`). Edges are watertight because hits that are nearer to one than their rounding error
(:func:`torchpt.search.tables.tolerances`) are decided in float64.
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
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.packet import KINDS, PacketSearch, scene_words
from torchpt.compiler.program import TracedStage
from torchpt.compiler.sinks import Sinks, Store
from torchpt.core.dispatch import dispatched
from torchpt.core.errors import SceneError
from torchpt.core.threads import parallel_for, thread_count
from torchpt.native import compile_time
from torchpt.physics.shapes.geometry import Geometry
from torchpt.search.base import Accel, Hits
from torchpt.search.leaf import quadric
from torchpt.search.tables import EXACT, Tables, affine_rows, extent, gaps, quadric_rows, tolerances

__all__ = ["MAX_TOLERANCE", "Brute", "Rows", "merge_quadric_hits", "rows_of"]

#: Largest tolerance at an edge, relative to the primitive's size (for rays at right angles to it, from within the scene): where
#: it is more, too many rays would be searched twice.
MAX_TOLERANCE = 1e-3
#: Rays of a block, by which threads share the work: a multiple of the 16 rays of a packet.
_BLOCK = 64
#: Rays times primitives that are worth another thread: about 50 microseconds.
_GRAIN = 100_000
#: Index of the address of the scene data in the head of a kernel's arguments.
_SEARCH = WORD["search"]


class Rows(NamedTuple):
    """Affine rows of primitives and their tolerances.

    Attributes:
        tables: affine rows of the primitives.
        size: largest coordinate of the scene.
        tolerance: ``(P,)`` float64, how near to an edge a hit is in doubt, see :func:`torchpt.search.tables.tolerances`.
    """

    tables: Tables
    size: float
    tolerance: Tensor

    @property
    def is_precise(self) -> bool:
        """Return True if float32 is precise enough for these primitives: no mixed scales, no slivers."""
        return bool((self.tolerance * self.size <= MAX_TOLERANCE).all())


def rows_of(geometry: Geometry) -> Rows:
    """Return the rows of primitives; the caller checks :attr:`Rows.is_precise`."""
    size, tables = extent(geometry), affine_rows(geometry)
    return Rows(tables, size, tolerances(tables.rows64, size))


class Brute(Accel):
    """Brute-force search in packets of rays (kernels of the lane compiler, CPU).

    Args:
        geometry: the primitives, on the CPU.
        threads: CPU threads; None: torch's number at the time of a search.
        rows: rows of the primitives, if they are known already.

    Attributes:
        tables: the tensors whose addresses are the first of ``words``.
        words: scene data that kernels read, see :func:`torchpt.compiler.packet.scene_words`.

    Raises:
        SceneError: the geometry is not on the CPU, or float32 rows are too coarse for it.
    """

    name = "brute"

    def __init__(self, geometry: Geometry, threads: int | None = None, rows: Rows | None = None) -> None:
        start = time.perf_counter()
        if geometry.p0.device.type != "cpu":
            raise SceneError("render.accel", "brute", "torch (brute runs on the CPU only)")
        tables, size, tolerance = rows = rows_of(geometry) if rows is None else rows
        if not rows.is_precise:
            raise SceneError("render.accel", "brute", "numba or torch (this scene's scales are too mixed for brute)")
        first_sphere, first_quadric = sum(geometry.counts[:3]), sum(geometry.counts[:4])
        spheres = slice(first_sphere, first_quadric)
        columns = (tables.rows64, tolerance[:, None], gaps(tables.rows64, size, geometry.counts)[:, None])
        rows64 = torch.cat(columns, 1)[:first_sphere].contiguous()
        rows32 = rows64.float()
        rows64[:, 12] *= EXACT
        centre_and_radius = torch.cat([geometry.p0, geometry.p1[:1]])[:, spheres].T.double()
        balls = torch.where(tables.area[spheres, None], centre_and_radius, torch.nan).contiguous()
        self.tables = rows32, rows64, balls
        rows_of_quadrics = quadric_rows(geometry).T.contiguous()
        # for each quadric its numbers and its primitive id
        self.quadrics = [
            (row, torch.tensor(prim, dtype=torch.int32)) for prim, row in enumerate(rows_of_quadrics, first_quadric)
        ]
        self.counts = list(geometry.counts)
        # the kinds in this scene; KINDS are those that kernels know, without quadrics
        self.kinds = tuple(kind for kind, count in zip(KINDS, self.counts, strict=False) if count)
        self.threads = threads
        self.words = scene_words(*self.tables, self.counts, size)
        self.build_seconds = time.perf_counter() - start

    def _intersect(self, o: Tensor, d: Tensor, t_max: Tensor) -> Hits:
        t, u, v = (torch.empty_like(t_max) for _ in range(3))
        prim = torch.empty_like(t_max, dtype=torch.int32)
        self._search(rays=(o, d, t_max), results=(t, prim, u, v), any_hit=False)
        for row, quadric_prim in self.quadrics:
            t, prim, u, v = merge_quadric_hits(o, d, t_max, t, prim, u, v, row, quadric_prim)
        return t, prim, u, v

    def _occluded(self, o: Tensor, d: Tensor, t_max: Tensor) -> Tensor:
        if self.quadrics:
            _, prim, _, _ = self._intersect(o, d, t_max)
            return prim >= 0
        blocked = torch.empty_like(t_max, dtype=torch.bool)
        self._search(rays=(o, d, t_max), results=(blocked,), any_hit=True)
        return blocked

    def _search(self, *, rays: Sequence[Tensor], results: Sequence[Tensor], any_hit: bool) -> None:
        """Intersect rays with planar primitives and spheres, on more threads the more work there is, and write ``results``."""
        call, count = _kernel(self.kinds, any_hit), results[0].shape[0]
        tensors = [(x.data_ptr(), x.element_size()) for x in (*rays, *results)]

        def search_blocks(first: int, last: int) -> None:
            start, end = first * _BLOCK, min(last * _BLOCK, count)
            # The kernel's arguments: the head (compiler/kernel.py), and for each tensor the address of the first ray's number,
            # and the numbers from one component to the next.
            arguments = [0] * len(HEAD)
            arguments[_SEARCH] = ctypes.addressof(self.words)
            for address, size in tensors:
                arguments += (address + start * size, count)
            in_memory = (ctypes.c_int64 * len(arguments))(*arguments)
            call(ctypes.addressof(in_memory), end - start)

        worthwhile = max(count * sum(self.counts) // _GRAIN, 1)
        # A worker thread has one thread, as callers share the work already.
        threads = min(thread_count(self.threads), thread_count(None), worthwhile)
        parallel_for(search_blocks, -(-count // _BLOCK), threads)

    def describe(self) -> dict[str, Any]:
        """See :meth:`Accel.describe`; there are no nodes, and the cost is 1 a primitive."""
        primitives = sum(self.counts)
        return {
            "name": self.name,
            "primitives": primitives,
            "nodes": 0,
            "leaves": 0,
            "sah_cost": float(primitives),
            "depth": 0,
            "bytes": sum(x.nbytes for x in (*self.tables, *(row for row, _ in self.quadrics))),
            "build_seconds": self.build_seconds,
        }


@functools.cache
def _kernel(kinds: tuple[str, ...], any_hit: bool) -> Any:
    """Compile the search among kinds of primitives; the kernel's tensors are rays ``o, d, t_max`` and the results.

    The graph is written by hand, as no tensor function has to be traced. Types are those of :mod:`torchpt.compiler.graph`:
    ``f`` float32, ``i`` int32, ``b`` bool, ``S`` several values of which ``part`` takes one.
    """
    graph = Graph()
    components = (3, 3, 1)  # of o, d, t_max
    ray = [graph.node("tensor", "f", extra=(tensor, k)) for tensor, n in enumerate(components) for k in range(n)]
    if any_hit:
        stores = [Store((graph.node("occluded", "b", *ray),), "b")]
    else:
        hits = graph.node("nearest", "S", *ray)
        # the results t, prim, u, v
        stores = [Store((graph.node("part", ty, hits, extra=k),), ty) for k, ty in enumerate("fiff")]
    compile_time.begin()
    try:
        return cache.compile_stage(TracedStage(graph, Sinks(store=stores), tensors=3, search=PacketSearch(kinds))).call
    finally:
        compile_time.end()


@dispatched
def merge_quadric_hits(
    o: Tensor, d: Tensor, t_max: Tensor, t: Tensor, prim: Tensor, u: Tensor, v: Tensor, row: Tensor, number: Tensor
) -> Hits:
    """Return the hits, replaced by those on a quadric where it is nearer; ``row (19,)`` is the quadric, ``number`` its id."""
    valid = torch.isfinite(o).all(0) & torch.isfinite(d).all(0)
    new_t, new_u, new_v = quadric(o, d, row[:, None])
    nearer = valid & (new_t > 0) & (new_t < torch.minimum(t, t_max))
    new = (new_t, number, new_u, new_v)
    return tuple(torch.where(nearer, x, old) for x, old in zip(new, (t, prim, u, v), strict=True))  # type: ignore[return-value]


# on CPU tensors the function runs as one compiled kernel; the last two arguments are the same for all rays
merge_quadric_hits.register(
    Lanewise(merge_quadric_hits.function, ("o", "d", "t_max", "t", "prim", "u", "v"), ("row", "number"))
)
