"""Affine rows of primitives for the searches, computed once in float64 and stored in float32.

A planar primitive becomes three affine rows ``(n, c)``, ``(a, ca)``, ``(b, cb)``: ``n . x + c`` is the signed distance
to its plane (``n`` unit), ``u(x) = a . x + ca`` and ``v(x) = b . x + cb`` its parameters. Every backend computes the
distance of a planar hit from the first row, which is as exact as the plane: a ray that leaves a surface is within a few
ulps of the surface's plane, however large the primitive.

P is the number of primitives, Q that of the quadrics among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchpt.physics.shapes.geometry import Geometry

__all__ = ["EXACT", "QUADRIC", "ROUNDING", "Tables", "affine_rows", "extent", "gaps", "quadric_rows", "tolerances"]

#: 32 units of float32 rounding. The affine test of a primitive errs by at most 16 of them times the magnitudes of the terms
#: (see :func:`tolerances`); the other half covers grazing rays, where ``n . d`` itself is uncertain.
ROUNDING = 2.0**-19
#: The rounding of float64 relative to that of float32.
EXACT = 2.0**-29
#: Numbers of a quadric: 12 of the transform to its own space, 7 coefficients (:class:`torchpt.physics.shapes.quadrics.Form`).
QUADRIC = 19


class Tables(NamedTuple):
    """Affine rows of primitives.

    Attributes:
        rows: ``(P, 12)`` float32: ``n c a ca b cb``, where ``n``, ``a`` and ``b`` are three numbers each; zeros for spheres,
            quadrics and primitives without area.
        rows64: the same in float64, not rounded.
        area: ``(P,)`` bool: True if the primitive has an area and finite numbers, so that it can be hit.
    """

    rows: Tensor
    rows64: Tensor
    area: Tensor


def affine_rows(geometry: Geometry) -> Tables:
    """Compute the affine rows of all primitives.

    Args:
        geometry: the primitives.

    Returns:
        Rows in both precisions, on the geometry's device. A primitive with zero area, a non-finite corner or a row that
        overflows float32 gets zero rows: its plane equation is 0 = 0, so it is never hit.
    """
    p0, p1, p2 = (p.double() for p in (geometry.p0, geometry.p1, geometry.p2))
    e1, e2 = p1 - p0, p2 - p0
    cross = torch.linalg.cross(e1, e2, dim=0)
    length = cross.square().sum(0).sqrt()
    first_sphere, first_quadric = sum(geometry.counts[:3]), sum(geometry.counts[:4])
    prim = torch.arange(geometry.size, device=p0.device)
    planar = prim < first_sphere
    n = cross / length
    a = torch.linalg.cross(e2, n, dim=0) / length
    b = torch.linalg.cross(n, e1, dim=0) / length
    # each of the three functions is 0 at p0, which gives its constant
    rows = torch.cat([r for x in (n, a, b) for r in (x, -(x * p0).sum(0, keepdim=True))])
    good_plane = planar & (length > 0) & torch.isfinite(rows.float()).all(0)
    rows = torch.where(good_plane, rows, 0.0)
    radius = p1[0]
    good_curved = ~planar & (prim < first_quadric)
    good_curved &= torch.isfinite(p0).all(0) & (radius.abs() > 0) & torch.isfinite(radius)
    if geometry.quadrics is not None:
        good_curved[first_quadric:] = torch.isfinite(quadric_rows(geometry)[:12]).all(0)
    return Tables(rows.float().T.contiguous(), rows.T, good_plane | good_curved)


def quadric_rows(geometry: Geometry) -> Tensor:
    """Return quadrics ``(19, Q)`` float64: three affine rows from the world to own space, NaN if singular, and coefficients.

    Searches intersect quadrics in their own space in float64, so that a ray leaving one is on the right side of it, however
    thin, sheared or distant the quadric is.
    """
    table = geometry.quadrics
    if table is None:
        return torch.zeros(QUADRIC, 0, dtype=torch.float64, device=geometry.p0.device)
    p0, e1, e2, e3 = table.frame.split(3)
    # the inverse of the matrix with columns e1, e2, e3: its cofactors over its determinant
    cofactors = (torch.linalg.cross(a, b, dim=0) for a, b in ((e2, e3), (e3, e1), (e1, e2)))
    det = (e1 * torch.linalg.cross(e2, e3, dim=0)).sum(0)
    rows = [row for n in cofactors for row in (n / det, -(n * p0).sum(0, keepdim=True) / det)]
    return torch.cat([*rows, table.form])


def extent(geometry: Geometry) -> float:
    """Return the largest absolute coordinate of the scene, at least the smallest normal float32."""
    if geometry.size == 0:
        return 1.0
    first_sphere, first_quadric = sum(geometry.counts[:3]), sum(geometry.counts[:4])
    spheres = slice(first_sphere, first_quadric)
    points = torch.stack([p[:, :first_sphere] for p in (geometry.p0, geometry.p1, geometry.p2)]).abs()
    sphere_bounds = geometry.p0[:, spheres].abs() + geometry.p1[0, spheres].abs()  # |centre| + radius
    magnitudes = torch.cat([points.reshape(-1), sphere_bounds.reshape(-1)])
    if geometry.quadrics is not None:
        quadric_bounds = geometry.quadrics.frame.abs().reshape(4, 3, -1).sum(0)  # |p0| + |e1| + |e2| + |e3|
        magnitudes = torch.cat([magnitudes, quadric_bounds.reshape(-1).float()])
    magnitudes = magnitudes[torch.isfinite(magnitudes)]
    return max(float(magnitudes.max()) if magnitudes.numel() else 1.0, torch.finfo(torch.float32).tiny)


def tolerances(rows: Tensor, scene_extent: float) -> Tensor:
    """Bound the rounding error of the affine test, per unit of ``|d| max(|o|, extent) / |n . d|`` (maximum norms).

    With ``U(x) = sum |a_i x_i| + |ca|`` and ``W`` likewise for the plane, the parameter ``u = u(o) - w(o) u(d) / w(d)``
    of a hit is computed with an error below ``16 eps (U(o) W(d) + W(o) U(d) + W(d)) / |w(d)|`` (standard model,
    eps = 2^-24; five roundings in each of the rows' sums, rounded rows included). A test that accepts this much beyond the
    edges accepts every hit that is inside in exact arithmetic; those within this much of an edge are tested again in float64.

    Args:
        rows: ``(P, 12)`` float64 rows.
        scene_extent: see :func:`extent`.

    Returns:
        ``(P,)`` float64.
    """
    rows = rows.abs()
    w, cw = rows[:, 0:3].sum(1), rows[:, 3]
    worst = torch.zeros_like(w)
    for first in (4, 8):  # first columns of u and of v
        u, cu = rows[:, first : first + 3].sum(1), rows[:, first + 3]
        worst = torch.maximum(worst, 2 * u * w + (cu * w + cw * u + w) / scene_extent)
    return ROUNDING * worst


def gaps(rows: Tensor, scene_extent: float, counts: Sequence[int]) -> Tensor:
    """Bound how far apart the edges of neighbours can be because their corners are rounded to float32, in parameters.

    Triangles share corners, so there is no gap between them. A rectangle's fourth corner follows from the other three and its
    pose, each a few roundings of a coordinate off.

    Args:
        rows: ``(P, 12)`` float64 rows.
        scene_extent: see :func:`extent`.
        counts: numbers of primitives of each kind.

    Returns:
        ``(P,)`` float64.
    """
    slope = torch.maximum(rows[:, 4:7].abs().sum(1), rows[:, 8:11].abs().sum(1))
    prim = torch.arange(len(rows), device=rows.device)
    rectangle = (prim >= counts[0]) & (prim < counts[0] + counts[1])
    return torch.where(rectangle, 2.0**-22 * scene_extent * slope, 0.0)
