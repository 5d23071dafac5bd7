"""Rays against one primitive each, by tensor operations.

Triangles and parallelograms are watertight after Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT
2013: corners are sheared into the ray's frame, where an edge function's sign depends on the edge alone, not on the
primitive. Products round monotonically, so a computed edge function is of the right sign or zero; zero counts as
inside. That holds without fused operations only. The distance comes from the plane, within the corners' depths.
The numba kernels (kernels_leaf.py) do the same operations in the same order.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Rays", "distances", "prepare_rays"]


class Rays(NamedTuple):
    """Rays and what follows from them alone.

    Attributes:
        o: ``(3, N)`` origins.
        d: ``(3, N)`` directions.
        inverse: ``(3, N)`` reciprocals for box tests, never infinite: no 0 * inf on axis-parallel rays.
        axes: ``(3, N)`` int64: the axis of the largest ``|d|`` last, the two that follow it cyclically first.
        shear: ``(3, N)``: d[x] / d[z], d[y] / d[z], 1 / d[z] in that order of axes.
    """

    o: Tensor
    d: Tensor
    inverse: Tensor
    axes: Tensor
    shear: Tensor

    def take(self, index: Tensor) -> Rays:
        """The rays at these places."""
        return Rays(*(x[:, index] for x in self))


def prepare_rays(o: Tensor, d: Tensor) -> Rays:
    """Computes the fields of :class:`Rays`."""
    size = d.abs()
    z = torch.where((size[0] >= size[1]) & (size[0] >= size[2]), 0, torch.where(size[1] >= size[2], 1, 2))
    axes = torch.stack([(z + 1) % 3, (z + 2) % 3, z])
    x, y, depth = d.gather(0, axes).unbind(0)
    smallest = (depth.abs() * 1e-20).clamp(min=1e-37)
    safe = torch.where(size < smallest, torch.copysign(smallest, d), d)
    return Rays(o, d, 1.0 / safe, axes, torch.stack([x / depth, y / depth, 1.0 / depth]))


def distances(
    rays: Rays, prim: Tensor, corners: Tensor, rows: Tensor, counts: list[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Where ray k meets primitive ``prim[k]``.

    Args:
        rays: N rays.
        prim: ``(N,)`` int64 primitive ids.
        corners: ``(9, P)`` float32: p0, p1, p2.
        rows: ``(12, P)`` float32, see :mod:`torchpt.accel.tables`.
        counts: primitives of each kind.

    Returns:
        ``t, u, v``; ``t`` is NaN (or not positive) where there is no hit.
    """
    disks, balls = counts[0] + counts[1], counts[0] + counts[1] + counts[2]
    row, corner = rows[:, prim], corners[:, prim]
    o, d = rays.o, rays.d
    away = row[0] * o[0] + row[1] * o[1] + row[2] * o[2] + row[3]
    along = row[0] * d[0] + row[1] * d[1] + row[2] * d[2]
    plane = -away / along
    plane = torch.where((plane > 0) & torch.isfinite(plane), plane, torch.nan)
    t, u, v = _polygon(rays, corner, plane, (prim >= counts[0]) if counts[1] else None)
    if counts[2]:
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
    return t, u, v


def _polygon(rays: Rays, corner: Tensor, plane: Tensor, four: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Triangles, and parallelograms where ``four`` is set."""

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
        det = torch.where(four, (f + h) * (g + k), det)
        near, far = torch.where(four, torch.minimum(near, dz), near), torch.where(four, torch.maximum(far, dz), far)
        low = torch.where(four, torch.minimum(torch.minimum(f, g), torch.minimum(h, k)), low)
        high = torch.where(four, torch.maximum(torch.maximum(f, g), torch.maximum(h, k)), high)
    inside = ((low >= 0) | (high <= 0)) & (det != 0)
    t = torch.minimum(torch.maximum(plane, near), far)
    return torch.where(inside, t, torch.nan), u, v


def _sphere(o: Tensor, d: Tensor, corner: Tensor) -> Tensor:
    """See :func:`torchpt.accel.kernels_sphere.sphere_distance`: Haines et al., Ray Tracing Gems ch. 7, in float64."""
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
