"""Intersect N rays with one primitive each, by tensor operations.

Triangles and parallelograms are watertight after Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT
2013: corners are sheared into the ray's frame, where an edge function's sign depends on the edge alone, not on the
primitive. Products round monotonically, so a computed edge function has the right sign or is zero; zero counts as
inside. This holds only without fused operations. The distance comes from the plane, clamped to the depths of the corners:
rounding may move the plane of a primitive seen edge-on anywhere, even behind the ray, which would open a hole.
The tree's kernels (``scripts/kernel_sources/tree_leaf.py``) do the same operations in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Rays", "distances", "prepare_rays", "quadric"]


class Rays(NamedTuple):
    """Rays with values precomputed from each ray alone.

    Attributes:
        o: ``(3, N)`` origins.
        d: ``(3, N)`` directions.
        inverse: ``(3, N)`` reciprocal directions for box tests, never infinite: no 0 * inf on axis-parallel rays.
        axes: ``(3, N)`` int64: the axis of the largest ``|d|`` last, before it the two that follow it cyclically.
        shear: ``(3, N)``: d[x] / d[z], d[y] / d[z], 1 / d[z] in that order of axes.
    """

    o: Tensor
    d: Tensor
    inverse: Tensor
    axes: Tensor
    shear: Tensor

    def take(self, index: Tensor) -> Rays:
        """Return the rays at ``index``."""
        return Rays(*(x[:, index] for x in self))


def prepare_rays(o: Tensor, d: Tensor) -> Rays:
    """Compute the fields of :class:`Rays`."""
    size = d.abs()
    z = torch.where((size[0] >= size[1]) & (size[0] >= size[2]), 0, torch.where(size[1] >= size[2], 1, 2))
    axes = torch.stack([(z + 1) % 3, (z + 2) % 3, z])
    x, y, depth = d.gather(0, axes).unbind(0)
    smallest = (depth.abs() * 1e-20).clamp(min=1e-37)
    safe = torch.where(size < smallest, torch.copysign(smallest, d), d)
    return Rays(o, d, 1.0 / safe, axes, torch.stack([x / depth, y / depth, 1.0 / depth]))


def distances(
    rays: Rays, prim: Tensor, corners: Tensor, rows: Tensor, quadrics: Tensor, counts: list[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Intersect ray k with primitive ``prim[k]``.

    Args:
        rays: N rays.
        prim: ``(N,)`` int64 primitive ids.
        corners: ``(9, P)`` float32: p0, p1, p2.
        rows: ``(12, P)`` float32, see :mod:`torchpt.search.tables`.
        quadrics: ``(19, Q)`` float64, or 18 rows if all linear terms are 0, see :func:`torchpt.search.tables.quadric_rows`.
        counts: primitives of each kind.

    Returns:
        ``t, u, v``; ``t`` is NaN or not positive for a miss.
    """
    disks, balls = counts[0] + counts[1], counts[0] + counts[1] + counts[2]
    row, corner = rows[:, prim], corners[:, prim]
    o, d = rays.o, rays.d
    away = row[0] * o[0] + row[1] * o[1] + row[2] * o[2] + row[3]
    along = row[0] * d[0] + row[1] * d[1] + row[2] * d[2]
    plane = -away / along
    t, u, v = _polygon(rays, corner, plane, (prim >= counts[0]) if counts[1] else None)
    if counts[2]:
        plane = torch.where((plane > 0) & torch.isfinite(plane), plane, torch.nan)
        x, y, z = (o + plane * d).unbind(0)
        a = row[4] * x + row[5] * y + row[6] * z + row[7]
        b = row[8] * x + row[9] * y + row[10] * z + row[11]
        disk = prim >= disks
        t = torch.where(disk, torch.where(a * a + b * b <= 1, plane, torch.nan), t)
        u, v = torch.where(disk, a, u), torch.where(disk, b, v)
    if counts[3]:
        ball = prim >= balls
        t = torch.where(ball, _sphere(o, d, corner), t)
        u, v = u.masked_fill(ball, 0.0), v.masked_fill(ball, 0.0)
    if counts[4]:
        first = balls + counts[3]
        curved = prim >= first
        found = quadric(o, d, quadrics[:, (prim - first).clamp(min=0)])
        t, u, v = (torch.where(curved, a, b) for a, b in zip(found, (t, u, v), strict=True))
    return t, u, v


def _polygon(rays: Rays, corner: Tensor, plane: Tensor, four: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Intersect triangles, or parallelograms where ``four`` is set."""

    def sheared(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, y, z = (p - rays.o).gather(0, rays.axes).unbind(0)
        return x - rays.shear[0] * z, y - rays.shear[1] * z, z * rays.shear[2]

    ax, ay, az = sheared(corner[0:3])
    bx, by, bz = sheared(corner[3:6])
    cx, cy, cz = sheared(corner[6:9])
    e = cx * by - cy * bx
    f = ax * cy - ay * cx
    g = bx * ay - by * ax
    det = e + f + g
    u, v = f / det, g / det
    near, far = torch.minimum(torch.minimum(az, bz), cz), torch.maximum(torch.maximum(az, bz), cz)
    low, high = torch.minimum(torch.minimum(e, f), g), torch.maximum(torch.maximum(e, f), g)
    if four is not None:
        dx, dy, dz = sheared((corner[3:6] + corner[6:9]) - corner[0:3])
        h = dx * by - dy * bx
        k = cx * dy - cy * dx
        u, v = torch.where(four, f / (f + h), u), torch.where(four, g / (g + k), v)
        det = torch.where(four, torch.minimum((f + h).abs(), (g + k).abs()), det)
        near, far = torch.where(four, torch.minimum(near, dz), near), torch.where(four, torch.maximum(far, dz), far)
        low = torch.where(four, torch.minimum(torch.minimum(f, g), torch.minimum(h, k)), low)
        high = torch.where(four, torch.maximum(torch.maximum(f, g), torch.maximum(h, k)), high)
    inside = ((low >= 0) | (high <= 0)) & (det != 0)
    t = torch.minimum(torch.maximum(plane, near), far)
    return torch.where(inside, t, torch.nan), u, v


def _sphere(o: Tensor, d: Tensor, corner: Tensor) -> Tensor:
    """Intersect spheres as ``sphere_distance`` of the tree's kernels: Haines et al., Ray Tracing Gems ch. 7, float64."""
    f, e, radius = o.double() - corner[0:3], d.double(), corner[3].double()
    a = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    b = -(f[0] * e[0] + f[1] * e[1] + f[2] * e[2])
    r = f + (b / a) * e
    disc = radius * radius - (r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    root = (a * disc).sqrt()
    q = b + torch.where(b >= 0, root, -root)
    near = (f[0] * f[0] + f[1] * f[1] + f[2] * f[2] - radius * radius) / q
    far = q / a
    low, high = torch.minimum(near, far), torch.maximum(near, far)
    return torch.where(low > 0, low, high).float()


def quadric(o: Tensor, d: Tensor, row: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the nearest positive ``t`` on quadrics, and the point's ``u, v``: float32; ``t`` is NaN for a miss.

    In its own space a quadric is ``x^2 + y^2 + k w^2 + 2 h w = r`` with ``w = z - s``, between two heights
    (:class:`torchpt.physics.shapes.quadrics.Form`). Half the discriminant of a ray ``f + t e`` is, by Lagrange's identity for
    this form, ``r a - (k (m_x^2 + m_y^2) + m_z^2) + h (h e_z^2 + 2 (e_y m_x - e_x m_y))`` with ``m = f x e``: no difference of
    large squares where h is 0. The roots come from ``q = b + sign(b) sqrt`` (Haines et al., Ray Tracing Gems ch. 7), all in
    float64.

    ``v`` is z, and ``u`` the distance along the square ``|x| + |y| = 1`` from +x, in [-2, 2]. For surfaces parametrized by
    the direction to their points ``u, v`` are octahedral (Cigolle et al., "A Survey of Efficient Representations for
    Independent Unit Vectors", JCGT 2014). Both are algebraic, so that backends agree; the inverse is
    :func:`torchpt.physics.shapes.quadrics.place`.

    Args:
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        row: ``(19, N)`` float64: transform from the world to own space, and the quadric's coefficients; with 18 rows h is 0.
    """
    px, py, pz = o.double().unbind(0)
    rx, ry, rz = d.double().unbind(0)
    fx = row[0] * px + row[1] * py + row[2] * pz + row[3]
    fy = row[4] * px + row[5] * py + row[6] * pz + row[7]
    fz = row[8] * px + row[9] * py + row[10] * pz + row[11]
    ex = row[0] * rx + row[1] * ry + row[2] * rz
    ey = row[4] * rx + row[5] * ry + row[6] * rz
    ez = row[8] * rx + row[9] * ry + row[10] * rz
    bend, level, shift, low, high, ball = *row[12:17], row[17] != 0
    wz = fz - shift
    a = ex * ex + ey * ey + bend * (ez * ez)
    b = -(fx * ex + fy * ey + bend * (wz * ez))
    c = fx * fx + fy * fy + bend * (wz * wz) - level
    mx, my, mz = fy * ez - wz * ey, wz * ex - fx * ez, fx * ey - fy * ex
    disc = level * a - (bend * (mx * mx + my * my) + mz * mz)
    if len(row) > 18:
        half = row[18]
        b, c = b - half * ez, c + 2.0 * half * wz
        disc = disc + half * (half * (ez * ez) + 2.0 * (ey * mx - ex * my))
    root = disc.sqrt()
    q = b + torch.where(b >= 0, root, -root)
    t1, t2 = c / q, q / a
    z1, z2 = fz + t1 * ez, fz + t2 * ez
    ok1 = (t1 > 0) & (t1 < torch.inf) & (z1 >= low) & (z1 <= high)
    ok2 = (t2 > 0) & (t2 < torch.inf) & (z2 >= low) & (z2 <= high)
    t = torch.where(ok1 & ~(ok2 & (t2 < t1)), t1, t2)
    x, y, z = fx + t * ex, fy + t * ey, fz + t * ez
    ring = x.abs() + y.abs()
    cosine = torch.where(ring > 0, x.abs() / ring, 1.0)
    u = torch.where(x >= 0, 1.0 - cosine, 1.0 + cosine) * torch.copysign(torch.ones_like(y), y)
    size = x.abs() + y.abs() + z.abs()
    p, q = x / size, y / size
    fold_p = (1.0 - q.abs()) * torch.copysign(torch.ones_like(p), p)
    fold_q = (1.0 - p.abs()) * torch.copysign(torch.ones_like(q), q)
    u = torch.where(ball, torch.where(z < 0, fold_p, p), u)
    v = torch.where(ball, torch.where(z < 0, fold_q, q), z)
    return torch.where(ok1 | ok2, t, torch.nan).float(), u.float(), v.float()
