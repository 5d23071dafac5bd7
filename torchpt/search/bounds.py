"""Axis-aligned boxes of primitives, and subsets of a geometry.

A :class:`~torchpt.physics.shapes.geometry.Geometry` stores its primitives kind after kind: triangles, rectangles, disks,
spheres, quadrics; ``counts`` has the number of each.
"""

from __future__ import annotations

from itertools import accumulate

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry, QuadricTable

__all__ = ["half_areas", "primitive_bounds", "select_primitives"]

#: Margin of a box relative to coordinates and size: four float32 roundings (2^-24 each).
_MARGIN = 2.0**-22
#: Primitives whose boxes are computed at once: of a large mesh the temporaries in float64 would be many times the boxes.
_BLOCK = 1 << 14


def primitive_bounds(geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Return the boxes of all primitives, enlarged by a few ulps: ``low, high``, each ``(3, P)`` float32.

    The margin is relative to the coordinates and to the size of the box. It keeps a ray that runs exactly in one of the
    primitive's bounding planes inside the box, and hits that a leaf test accepts because of its own rounding.

    A rectangle's fourth corner is ``p1 + p2 - p0``; an ellipse extends ``sqrt(e1^2 + e2^2)`` from its centre on each axis.
    """
    low, high = (torch.empty_like(geometry.p0, dtype=torch.float32) for _ in range(2))
    for first in range(0, geometry.size, _BLOCK):
        block = slice(first, min(first + _BLOCK, geometry.size))
        prim = torch.arange(block.start, block.stop, device=low.device)
        low[:, block], high[:, block] = _bounds(select_primitives(geometry, prim))
    return low, high


def _bounds(geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Return :func:`primitive_bounds` of one block."""
    p0, p1, p2 = geometry.p0.double(), geometry.p1.double(), geometry.p2.double()
    # the ids one past the last triangle, rectangle, disk and sphere; the others are quadrics
    triangles_end, rectangles_end, disks_end, spheres_end = accumulate(geometry.counts[:4])
    low, high = torch.minimum(torch.minimum(p0, p1), p2), torch.maximum(torch.maximum(p0, p1), p2)
    rectangles, disks = slice(triangles_end, rectangles_end), slice(rectangles_end, disks_end)
    # the searches use the sum in float32 as the corner
    fourth = ((geometry.p1 + geometry.p2) - geometry.p0)[:, rectangles].double()
    low[:, rectangles] = torch.minimum(low[:, rectangles], fourth)
    high[:, rectangles] = torch.maximum(high[:, rectangles], fourth)
    half_sizes = ((p1 - p0)[:, disks].square() + (p2 - p0)[:, disks].square()).sqrt()
    # a sphere has its radius in p1[0]
    half_sizes = torch.cat([half_sizes, p1[:1, disks_end:spheres_end].abs().expand(3, -1)], 1)
    centred = slice(rectangles_end, spheres_end)  # disks and spheres have their centre in p0
    low[:, centred], high[:, centred] = p0[:, centred] - half_sizes, p0[:, centred] + half_sizes
    if geometry.quadrics is not None:
        low[:, spheres_end:], high[:, spheres_end:] = geometry.quadrics.low, geometry.quadrics.high
    margin = _MARGIN * (torch.maximum(low.abs(), high.abs()) + (high - low).amax(0))
    low, high = low - margin, high + margin
    down, up = low.float(), high.float()  # rounded to nearest; moved outward below where that went inward
    down = torch.where(down.double() > low, torch.nextafter(down, torch.full_like(down, -torch.inf)), down)
    up = torch.where(up.double() < high, torch.nextafter(up, torch.full_like(up, torch.inf)), up)
    return down, up


def select_primitives(geometry: Geometry, prim: Tensor) -> Geometry:
    """Return the geometry of some primitives, without instances; ``prim`` ``(K,)`` int64 are their ids in ascending order."""
    # the first id of each kind, and the number of primitives
    starts = torch.tensor([0, *accumulate(geometry.counts)], device=prim.device)
    triangles, rectangles, disks, spheres, quadrics = torch.diff(torch.searchsorted(prim, starts)).tolist()
    p0, p1, p2 = (p.index_select(1, prim) for p in (geometry.p0, geometry.p1, geometry.p2))
    table, selected = geometry.quadrics, None
    if table is not None:
        columns = prim[len(prim) - quadrics :] - starts[4]
        fields = (x.index_select(1, columns) for x in (table.frame, table.form, table.low, table.high))
        selected = QuadricTable(*fields)
    return Geometry(p0, p1, p2, (triangles, rectangles, disks, spheres, quadrics), selected)


def half_areas(low: Tensor, high: Tensor) -> Tensor:
    """Return half the surface areas ``(N,)`` of boxes ``(3, N)``."""
    x, y, z = (high - low).unbind(0)
    return x * y + y * z + z * x
