"""Emissive quadrics under affine maps, sampled uniformly by area in object space.

Under a map M with cofactor matrix C the area element at the object-space normal n grows by ``|C n| = |det M| / |M^T N|``,
where N is the unit normal in the world: N alone gives the density, of sampled and of hit points.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import affine, dot
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.surface import Faces, Surface, SurfaceSample
from torchpt.physics.shapes import quadrics

__all__ = ["Quadric", "world_area"]


def world_area(area: Tensor, e1: Tensor, e2: Tensor, e3: Tensor, normal: Tensor) -> Tensor:
    """Return one over the density by area at unit normals ``normal``.

    Args:
        area: area in object space times ``|det|`` ``(N,)``.
        e1: images of the axes of object space ``(3, N)``: this one of x.
        e2: of y ``(3, N)``.
        e3: of z ``(3, N)``.
        normal: unit normal in the world ``(3, N)``.
    """
    a, b, c = dot(e1, normal), dot(e2, normal), dot(e3, normal)
    square = a * a + b * b + c * c
    return area / torch.where(square > 0, square, 1.0).sqrt()


class Quadric(Surface):
    """An ellipsoid, or the side of a cylinder or cone."""

    name = "quadric"
    convex = True
    needs_quadrics = True

    @classmethod
    def areas(cls, faces: Faces) -> tuple[Tensor, Tensor]:
        """See :meth:`Surface.areas`: the area in object space times ``|det|``; the area in the world by quadrature."""
        assert faces.quadrics is not None and faces.frame is not None
        area, whole = quadrics.areas(faces.quadrics, faces.frame)
        return area.index_select(0, faces.column), whole.index_select(0, faces.column)

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample_area`."""
        assert at.quadrics is not None
        own = quadrics.sample(at.quadrics, u)  # (3, N) in object space
        p = affine(at.p0 + at.e1 * own[0], at.e2, own[1], at.quadrics.e3, own[2])
        return SurfaceSample(p=p, normal=quadrics.outward(at.quadrics, own), own=own)

    @classmethod
    def size(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """See :meth:`Surface.size`."""
        assert at.quadrics is not None
        return world_area(at.area, at.e1, at.e2, at.quadrics.e3, normal)

    @classmethod
    def bound(cls, at: Lights, normal: Tensor) -> Tensor | None:
        """See :meth:`Surface.bound`."""
        assert at.quadrics is not None
        return dot(normal.detach().abs(), at.quadrics.coordinate_bound)
