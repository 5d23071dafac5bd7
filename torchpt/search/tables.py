"""What every search needs of a primitive, computed once in float64 and stored in float32.

A planar primitive becomes three affine rows ``(n, c)``, ``(a, ca)``, ``(b, cb)``: ``n . x + c`` is the signed distance
to its plane (``n`` unit), ``u(x) = a . x + ca`` and ``v(x) = b . x + cb`` its parameters. Every backend takes the
distance of a planar hit from the first row, so that it is as exact as the plane is: a ray that leaves a surface,
however large the primitive, knows the surface's own plane to a few ulps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry

__all__ = ["QUADRIC", "ROUNDING", "Tables", "affine_rows", "extent", "quadric_rows", "tolerances"]

#: 32 units of float32 rounding. The affine test of a primitive errs by at most 16 of them times the magnitudes that
#: enter (see :func:`tolerances`); the other half covers grazing rays, where ``n . d`` itself is uncertain.
ROUNDING = 2.0**-19
#: Numbers of a quadric: its map to its own space, and its form there (:class:`torchpt.physics.shapes.quadrics.Form`).
QUADRIC = 19


class Tables(NamedTuple):
    """Per-primitive numbers.

    Attributes:
        rows: ``(P, 12)`` float32: ``n c a ca b cb``; zeros for spheres, quadrics and primitives without area.
        rows64: the same in float64, not rounded.
        area: ``(P,)`` bool: the primitive can be hit.
    """

    rows: Tensor
    rows64: Tensor
    area: Tensor


def affine_rows(geometry: Geometry) -> Tables:
    """The affine rows of all primitives.

    Args:
        geometry: the primitives.

    Returns:
        Rows in both precisions, on the geometry's device. A primitive with zero area, a non-finite corner or a row that
        overflows float32 gets zero rows: its plane equation reads 0 = 0, which is never hit.
    """
    p0, p1, p2 = (p.double() for p in (geometry.p0, geometry.p1, geometry.p2))
    e1, e2 = p1 - p0, p2 - p0
    cross = torch.linalg.cross(e1, e2, dim=0)
    length = cross.square().sum(0).sqrt()
    first, balls = sum(geometry.counts[:3]), sum(geometry.counts[:4])
    number = torch.arange(geometry.size, device=p0.device)
    planar = number < first
    n = cross / length
    a = torch.linalg.cross(e2, n, dim=0) / length
    b = torch.linalg.cross(n, e1, dim=0) / length
    rows = torch.cat([r for x in (n, a, b) for r in (x, -(x * p0).sum(0, keepdim=True))])
    good = planar & (length > 0) & torch.isfinite(rows.float()).all(0)
    rows = torch.where(good, rows, 0.0)
    round_ = ~planar & (number < balls) & torch.isfinite(p0).all(0) & (p1[0].abs() > 0) & torch.isfinite(p1[0])
    if geometry.quadrics is not None:
        round_[balls:] = torch.isfinite(quadric_rows(geometry)[:12]).all(0)
    return Tables(rows.float().T.contiguous(), rows.T, good | round_)


def quadric_rows(geometry: Geometry) -> Tensor:
    """World to own space of the quadrics ``(19, Q)`` float64: three affine rows, NaN where there are none, and the form.

    Searches intersect quadrics in their own space and in float64: however thin, sheared or distant one is, a ray that
    leaves it knows its side.
    """
    table = geometry.quadrics
    if table is None:
        return torch.zeros(QUADRIC, 0, dtype=torch.float64, device=geometry.p0.device)
    p0, e1, e2, e3 = table.frame.split(3)
    faces = (torch.linalg.cross(a, b, dim=0) for a, b in ((e2, e3), (e3, e1), (e1, e2)))
    det = (e1 * torch.linalg.cross(e2, e3, dim=0)).sum(0)
    rows = [row for n in faces for row in (n / det, -(n * p0).sum(0, keepdim=True) / det)]
    return torch.cat([*rows, table.form])


def extent(geometry: Geometry) -> float:
    """Largest absolute coordinate of the scene (at least the smallest normal float32)."""
    if geometry.size == 0:
        return 1.0
    planar, round_ = sum(geometry.counts[:3]), sum(geometry.counts[:4])
    points = torch.stack([p[:, :planar] for p in (geometry.p0, geometry.p1, geometry.p2)]).abs()
    balls = geometry.p0[:, planar:round_].abs() + geometry.p1[0, planar:round_].abs()
    both = torch.cat([points.reshape(-1), balls.reshape(-1)])
    if geometry.quadrics is not None:
        reach = geometry.quadrics.frame.abs().reshape(4, 3, -1).sum(0)
        both = torch.cat([both, reach.reshape(-1).float()])
    both = both[torch.isfinite(both)]
    return max(float(both.max()) if both.numel() else 1.0, 2.0**-126)


def tolerances(rows: Tensor, scene_extent: float) -> Tensor:
    """Rounding error of the affine test, per unit of ``|d| max(|o|, extent) / |n . d|`` (maximum norms).

    With ``U(x) = sum |a_i x_i| + |ca|`` and ``W`` likewise for the plane, the parameter ``u = u(o) - w(o) u(d) / w(d)``
    of a hit is computed with an error below ``16 eps (U(o) W(d) + W(o) U(d) + W(d)) / |w(d)|`` (standard model,
    eps = 2^-24; five roundings in each of the rows' sums, rounded rows included). A primitive that accepts this much
    beyond its edges accepts everything that is inside in exact arithmetic: edges that two primitives share cannot leak.

    Args:
        rows: ``(P, 12)`` float64 rows.
        scene_extent: see :func:`extent`.

    Returns:
        ``(P,)`` float64.
    """
    rows = rows.abs()
    w, cw = rows[:, 0:3].sum(1), rows[:, 3]
    worst = torch.zeros_like(w)
    for k in (4, 8):
        u, cu = rows[:, k : k + 3].sum(1), rows[:, k + 3]
        worst = torch.maximum(worst, 2 * u * w + (cu * w + cw * u + w) / scene_extent)
    return ROUNDING * worst
