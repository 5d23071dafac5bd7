"""Intersect N rays with one primitive each, by tensor operations.

Triangles and parallelograms are watertight after Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT
2013: corners are sheared into the ray's frame, where an edge function's sign depends on the edge alone, not on the
primitive. Products round monotonically, so a computed edge function has the right sign or is zero; zero counts as
inside. This holds only without fused multiply-adds. The distance comes from the plane (:mod:`torchpt.search.tables`), clamped
to the depths of the corners: rounding may move the plane of a primitive seen edge-on anywhere, even behind the ray, which
would open a hole.

The kernels of the wide tree (``scripts/kernel_sources/tree_leaf.py``) do the same operations in the same order.
"""

from __future__ import annotations

from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Rays", "distances", "prepare_rays", "quadric"]

#: For box tests, components of a direction are at least this fraction of the largest one, and at least this number: the
#: reciprocals are finite in float32.
_SMALLEST_RATIO, _SMALLEST = 1e-20, 1e-37


class Rays(NamedTuple):
    """Rays with values precomputed from each ray alone.

    Attributes:
        o: ``(3, N)`` origins.
        d: ``(3, N)`` directions.
        inverse: ``(3, N)`` reciprocal directions for box tests, never infinite: no 0 * inf on axis-parallel rays.
        axes: ``(3, N)`` int64: the axes of the world that are x, y, z of the ray's frame. z is the axis of the largest ``|d|``;
            x and y are those that follow it cyclically.
        shear: ``(3, N)``: d[x] / d[z], d[y] / d[z], 1 / d[z] with these axes.
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
    smallest = (depth.abs() * _SMALLEST_RATIO).clamp(min=_SMALLEST)
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
        counts: numbers of triangles, rectangles, disks, spheres and quadrics, whose ids come in this order.

    Returns:
        ``t, u, v``; ``t`` is NaN or not positive for a miss.
    """
    first_rectangle, first_disk, first_sphere, first_quadric = accumulate(counts[:4])
    _, rectangles, disks, spheres, curved = counts
    row, corner = rows[:, prim], corners[:, prim]
    o, d = rays.o, rays.d
    height = row[0] * o[0] + row[1] * o[1] + row[2] * o[2] + row[3]  # signed distance from the plane to the origin
    slope = row[0] * d[0] + row[1] * d[1] + row[2] * d[2]  # its change for each unit of t
    plane = -height / slope  # t of the plane
    # The test of a kind runs on all rays; its result is taken where the primitive is of this kind.
    t, u, v = _polygon(rays, corner, plane, (prim >= first_rectangle) if rectangles else None)
    if disks:
        plane = torch.where((plane > 0) & torch.isfinite(plane), plane, torch.nan)
        x, y, z = (o + plane * d).unbind(0)
        disk_u = row[4] * x + row[5] * y + row[6] * z + row[7]
        disk_v = row[8] * x + row[9] * y + row[10] * z + row[11]
        is_disk = prim >= first_disk
        t = torch.where(is_disk, torch.where(disk_u * disk_u + disk_v * disk_v <= 1, plane, torch.nan), t)
        u, v = torch.where(is_disk, disk_u, u), torch.where(is_disk, disk_v, v)
    if spheres:
        is_sphere = prim >= first_sphere
        t = torch.where(is_sphere, _sphere(o, d, corner), t)
        u, v = u.masked_fill(is_sphere, 0.0), v.masked_fill(is_sphere, 0.0)
    if curved:
        is_quadric = prim >= first_quadric
        hits = quadric(o, d, quadrics[:, (prim - first_quadric).clamp(min=0)])
        t, u, v = (torch.where(is_quadric, new, old) for new, old in zip(hits, (t, u, v), strict=True))
    return t, u, v


def _polygon(
    rays: Rays, corner: Tensor, plane: Tensor, is_parallelogram: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Intersect triangles, or parallelograms where ``is_parallelogram`` is set.

    Args:
        rays: N rays.
        corner: ``(9, N)``: p0, p1, p2, called a, b, c below; d is a parallelogram's fourth corner, opposite to a.
        plane: ``(N,)``: t of the primitive's plane.
        is_parallelogram: ``(N,)`` bool; None: all are triangles.

    Returns:
        ``t, u, v``; ``t`` is NaN for a miss.
    """

    def sheared(p: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return a point in the ray's frame, where the ray runs along z and z is its t."""
        x, y, z = (p - rays.o).gather(0, rays.axes).unbind(0)
        return x - rays.shear[0] * z, y - rays.shear[1] * z, z * rays.shear[2]

    ax, ay, az = sheared(corner[0:3])
    bx, by, bz = sheared(corner[3:6])
    cx, cy, cz = sheared(corner[6:9])
    # Edge functions: twice the signed areas of the triangles between an edge and the ray, which is at x = y = 0.
    bc = cx * by - cy * bx
    ca = ax * cy - ay * cx
    ab = bx * ay - by * ax
    det = bc + ca + ab
    u, v = ca / det, ab / det
    near, far = torch.minimum(torch.minimum(az, bz), cz), torch.maximum(torch.maximum(az, bz), cz)
    low, high = torch.minimum(torch.minimum(bc, ca), ab), torch.maximum(torch.maximum(bc, ca), ab)
    if is_parallelogram is not None:
        four = is_parallelogram
        dx, dy, dz = sheared((corner[3:6] + corner[6:9]) - corner[0:3])
        bd = dx * by - dy * bx
        dc = cx * dy - cy * dx
        # Opposite edges are parallel: the sums of their edge functions are the parallelogram's area, wherever the ray is.
        u, v = torch.where(four, ca / (ca + bd), u), torch.where(four, ab / (ab + dc), v)
        det = torch.where(four, torch.minimum((ca + bd).abs(), (ab + dc).abs()), det)
        near, far = torch.where(four, torch.minimum(near, dz), near), torch.where(four, torch.maximum(far, dz), far)
        low = torch.where(four, torch.minimum(torch.minimum(ca, ab), torch.minimum(bd, dc)), low)
        high = torch.where(four, torch.maximum(torch.maximum(ca, ab), torch.maximum(bd, dc)), high)
    inside = ((low >= 0) | (high <= 0)) & (det != 0)
    t = torch.minimum(torch.maximum(plane, near), far)
    return torch.where(inside, t, torch.nan), u, v


def _sphere(o: Tensor, d: Tensor, corner: Tensor) -> Tensor:
    """Return the nearest positive ``t`` ``(N,)`` on spheres, NaN for a miss; ``corner`` is the centre, then the radius.

    Haines et al., Ray Tracing Gems ch. 7, in float64, by the same operations as ``sphere_distance`` of the tree's kernels.
    """
    f, e, radius = o.double() - corner[0:3], d.double(), corner[3].double()  # the ray about the centre is f + t e
    a = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
    b = -(f[0] * e[0] + f[1] * e[1] + f[2] * e[2])
    r = f + (b / a) * e  # the point of the ray closest to the centre
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
        row: ``(19, N)`` float64, see :func:`torchpt.search.tables.quadric_rows`: the transform from the world to own space,
            then k, r, s, the two heights, a flag for octahedral ``u, v``, and h. With 18 rows h is 0.
    """
    px, py, pz = o.double().unbind(0)
    rx, ry, rz = d.double().unbind(0)
    fx = row[0] * px + row[1] * py + row[2] * pz + row[3]
    fy = row[4] * px + row[5] * py + row[6] * pz + row[7]
    fz = row[8] * px + row[9] * py + row[10] * pz + row[11]
    ex = row[0] * rx + row[1] * ry + row[2] * rz
    ey = row[4] * rx + row[5] * ry + row[6] * rz
    ez = row[8] * rx + row[9] * ry + row[10] * rz
    bend, level, shift, low, high, octahedral = *row[12:17], row[17] != 0  # k, r, s, lower and upper height, flag
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
    t1, t2 = c / q, q / a  # in either order
    z1, z2 = fz + t1 * ez, fz + t2 * ez
    ok1 = (t1 > 0) & (t1 < torch.inf) & (z1 >= low) & (z1 <= high)
    ok2 = (t2 > 0) & (t2 < torch.inf) & (z2 >= low) & (z2 <= high)
    t = torch.where(ok1 & ~(ok2 & (t2 < t1)), t1, t2)
    x, y, z = fx + t * ex, fy + t * ey, fz + t * ez
    ring = x.abs() + y.abs()
    x_share = torch.where(ring > 0, x.abs() / ring, 1.0)
    u = torch.where(x >= 0, 1.0 - x_share, 1.0 + x_share) * torch.copysign(torch.ones_like(y), y)
    size = x.abs() + y.abs() + z.abs()
    p, q = x / size, y / size
    # points of the lower half of the octahedron are folded out over the edges of the upper half
    fold_p = (1.0 - q.abs()) * torch.copysign(torch.ones_like(p), p)
    fold_q = (1.0 - p.abs()) * torch.copysign(torch.ones_like(q), q)
    u = torch.where(octahedral, torch.where(z < 0, fold_p, p), u)
    v = torch.where(octahedral, torch.where(z < 0, fold_q, q), z)
    return torch.where(ok1 | ok2, t, torch.nan).float(), u.float(), v.float()
