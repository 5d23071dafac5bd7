"""Emissive spheres: from outside the visible cone is sampled uniformly, from inside the whole sphere.

Pharr, Jakob, Humphreys, *Physically Based Rendering*, 4th ed., section 6.2.4; a series below ``sin^2 = 6.9e-4`` keeps distant
lights accurate.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.math.sampling import one_minus_cos, uniform_cone, uniform_sphere
from torchpt.math.vectors import Frame, dot, inverse_square, normalize
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.surface import Faces, Surface, SurfaceSample

__all__ = ["Sphere", "inverse_pdf", "sample"]


def _cone(x: Tensor, centre: Tensor, radius: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the vector to the centre, distance, mask of points outside, and ``1 - cos`` of the visible cone's half angle."""
    axis = centre - x
    square = dot(axis, axis)
    outside = square > radius * radius * (1.0 + 2.0**-18)  # nearer, the cone is a half space up to rounding
    safe = torch.where(outside, square, 4.0 * radius * radius)  # any distance outside keeps unused lanes finite
    return axis, safe.sqrt(), outside, one_minus_cos(radius * radius / safe)


def sample(x: Tensor, centre: Tensor, radius: Tensor, flip: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Sample points ``(3, N)`` on spheres as seen from ``x (3, N)``; return them and unit normals on the emitting side.

    ``flip (N,)`` is -1 for spheres that emit inward, else 1; ``u (2, N)`` is in [0, 1).
    """
    axis, distance, outside, width = _cone(x, centre, radius)
    local = uniform_cone(u, width)
    sin2 = local[0] * local[0] + local[1] * local[1]
    # sqrt(r^2 - (distance sin)^2), and at the limb not the root of a rounding error, by which derivatives would be divided.
    half = distance * (width * (1.0 - u[0]) * (2.0 - width * (1.0 + u[0]))).clamp_min(0.0).sqrt()
    depth = distance * local[2] - half
    # From the centre to the point, in the cone's frame: z is depth cos - distance, written without cancellation.
    seen = torch.stack((local[0] * depth, local[1] * depth, -(sin2 * distance + local[2] * half)))
    seen = Frame.about(normalize(axis)).to_world(normalize(seen))
    normal = torch.where(outside, seen, uniform_sphere(u))
    return centre + normal * radius, normal * flip


def inverse_pdf(x: Tensor, centre: Tensor, radius: Tensor, normal: Tensor, wi: Tensor, square: Tensor) -> Tensor:
    """Return ``1 / pdf`` in steradians ``(N,)`` of :func:`sample` at a point with this normal; 0 behind the emitting side."""
    _, _, outside, width = _cone(x, centre, radius)
    cosine = -dot(wi, normal)
    whole = (4.0 * math.pi) * radius * radius * cosine * inverse_square(square)
    return torch.where(cosine > 0, torch.where(outside, (2.0 * math.pi) * width, whole), 0.0)


class Sphere(Surface):
    """A sphere; ``Lights.p0`` is its centre, ``Lights.e1`` begins with its radius."""

    name = "sphere"
    convex = True

    @classmethod
    def areas(cls, faces: Faces) -> tuple[Tensor, Tensor]:
        """See :meth:`Surface.areas`."""
        area = (4.0 * math.pi) * faces.e1[0].double() ** 2
        return area, area.detach()

    @classmethod
    def sample_area(cls, at: Lights, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample_area`."""
        outward = uniform_sphere(u)
        return SurfaceSample(p=at.p0 + outward * at.e1[0], normal=outward * at.flip)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor) -> SurfaceSample:
        """See :meth:`Surface.sample`."""
        # Detached: as the reference point moves, the point stays fixed on the light, as on planar lights.
        radius = at.e1[0]
        p, normal = sample(x.detach(), at.p0.detach(), radius.detach(), at.flip, u)
        grown = radius / torch.where(radius == 0, 1.0, radius).detach()  # 1; rows of other kinds may have radius 0
        return SurfaceSample(p=at.p0 + (p - at.p0).detach() * grown, normal=normal)

    @classmethod
    def inverse_pdf(
        cls, at: Lights, x: Tensor, normal: Tensor, wi: Tensor, square: Tensor, by_area: Tensor
    ) -> Tensor | None:
        """See :meth:`Surface.inverse_pdf`."""
        found = inverse_pdf(x.detach(), at.p0.detach(), at.e1[0].detach(), normal, wi.detach(), square.detach())
        if not by_area.requires_grad:
            return found
        # In area measure the derivative is the one of planar lights.
        value = by_area.detach()
        return found * torch.where(value > 0, by_area / torch.where(value > 0, value, 1.0), 1.0)
