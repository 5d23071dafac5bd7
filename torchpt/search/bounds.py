"""Axis-aligned boxes of primitives."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry, QuadricTable

__all__ = ["half_areas", "primitive_bounds", "select_primitives"]


def primitive_bounds(geometry: Geometry) -> tuple[Tensor, Tensor]:
    """Return the boxes of all primitives, enlarged by a few ulps: ``low, high``, each ``(3, P)`` float32.

    The margin (relative to coordinates and size) keeps inside the box rays that run exactly in one of its faces, and hits that
    a leaf test accepts by rounding.

    A rectangle's fourth corner is ``p1 + p2 - p0``; an ellipse extends ``sqrt(e1^2 + e2^2)`` from its centre on each axis.
    """
    p0, p1, p2 = geometry.p0.double(), geometry.p1.double(), geometry.p2.double()
    n_tri, n_rect, n_disk, n_ball, _ = geometry.counts
    low, high = torch.minimum(torch.minimum(p0, p1), p2), torch.maximum(torch.maximum(p0, p1), p2)
    # Ids up to a are triangles, up to b rectangles, up to c disks, up to q spheres, the others quadrics.
    a, b, c, q = n_tri, n_tri + n_rect, n_tri + n_rect + n_disk, n_tri + n_rect + n_disk + n_ball
    # the searches use the float32 sum as the corner
    fourth = ((geometry.p1 + geometry.p2) - geometry.p0)[:, a:b].double()
    low[:, a:b], high[:, a:b] = torch.minimum(low[:, a:b], fourth), torch.maximum(high[:, a:b], fourth)
    reach = ((p1 - p0)[:, b:c].square() + (p2 - p0)[:, b:c].square()).sqrt()
    # ``p1`` of a sphere has its radius as x.
    reach = torch.cat([reach, p1[:1, c:q].abs().expand(3, -1)], 1)
    low[:, b:q], high[:, b:q] = p0[:, b:q] - reach, p0[:, b:q] + reach
    if geometry.quadrics is not None:
        low[:, q:], high[:, q:] = geometry.quadrics.low, geometry.quadrics.high
    margin = 2.0**-22 * (torch.maximum(low.abs(), high.abs()) + (high - low).amax(0))
    low, high = low - margin, high + margin
    down, up = low.float(), high.float()
    down = torch.where(down.double() > low, torch.nextafter(down, torch.full_like(down, -torch.inf)), down)
    up = torch.where(up.double() < high, torch.nextafter(up, torch.full_like(up, torch.inf)), up)
    return down.contiguous(), up.contiguous()


def select_primitives(geometry: Geometry, prim: Tensor) -> Geometry:
    """Return the primitives with ids ``prim`` ``(K,)`` int64, in ascending order."""
    starts = torch.tensor([sum(geometry.counts[:k]) for k in range(6)], device=prim.device)
    a, b, c, d, e = torch.diff(torch.searchsorted(prim, starts)).tolist()
    p0, p1, p2 = (p.index_select(1, prim) for p in (geometry.p0, geometry.p1, geometry.p2))
    table, quadrics = geometry.quadrics, None
    if table is not None:
        columns = prim[len(prim) - e :] - starts[4]
        parts = (x.index_select(1, columns) for x in (table.frame, table.form, table.low, table.high))
        quadrics = QuadricTable(*parts)
    return Geometry(p0, p1, p2, (a, b, c, d, e), quadrics)


def half_areas(low: Tensor, high: Tensor) -> Tensor:
    """Return half the surface areas ``(N,)`` of boxes ``(3, N)``."""
    x, y, z = (high - low).unbind(0)
    return x * y + y * z + z * x
