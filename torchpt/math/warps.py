"""Warps of the unit square ``(2, N)`` onto domains, with their densities. Inputs lie in ``[0, 1)``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = [
    "concentric_disk",
    "cosine_hemisphere",
    "one_minus_cos",
    "uniform_cone",
    "uniform_hemisphere",
    "uniform_polygon",
    "uniform_sphere",
    "uniform_triangle",
]


def concentric_disk(u: Tensor) -> Tensor:
    """Area-preserving map to the unit disk ``(2, N)`` (Shirley and Chiu, *A Low Distortion Map*, 1997)."""
    wide, r, phi = _concentric(u)
    c, s = torch.cos(phi), torch.sin(phi)
    return r * torch.stack((torch.where(wide, c, s), torch.where(wide, s, c)))


def _concentric(u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The concentric map's signed radius and its angle, from the x axis where ``wide``, else from the y axis (mirrored)."""
    a, b = 2.0 * u[0] - 1.0, 2.0 * u[1] - 1.0
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    # The quotient is 0/0 only at the centre, where r = 0 makes the angle irrelevant.
    ratio = torch.where(wide, b, a) / torch.where(r == 0, 1.0, r)
    return wide, r, (math.pi / 4) * ratio


def uniform_polygon(u: Tensor, sides: int) -> Tensor:
    """Points ``(2, N)`` uniform over the regular polygon in the unit circle, one of its corners at ``(0, 1)``.

    The concentric map to the disk, then each sector of the disk onto its triangle: a share of the angle becomes the same
    share of the edge. That preserves area as well and is continuous, so that strata of the square stay compact.
    """
    wide, r, phi = _concentric(u)
    # Anticlockwise from the upper corner: half a turn on where the radius is negative, a quarter back from the x axis.
    turn = phi * (0.5 / math.pi)
    turn = torch.where(wide, turn - 0.25, -turn) + torch.where(r < 0, 0.5, 0.0)
    place = turn * sides
    edge = torch.floor(place)
    middle = (edge + 0.5) * (2.0 * math.pi / sides)
    c, s = torch.cos(middle), torch.sin(middle)
    size = r.abs()
    out = size * math.cos(math.pi / sides)
    along = size * (2.0 * (place - edge) - 1.0) * math.sin(math.pi / sides)
    return torch.stack((-s * out - c * along, c * out - s * along))


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` about ``+z`` with density ``cos(theta) / pi`` (Malley's method)."""
    d = concentric_disk(u)
    z = torch.addcmul(torch.addcmul(torch.ones_like(d[0]), d[0], d[0], value=-1), d[1], d[1], value=-1)
    return torch.stack((d[0], d[1], z.clamp_min(0.0).sqrt()))


def uniform_hemisphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` with density ``1 / 2 pi``."""
    z = u[0]
    r = (1.0 - z * z).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def uniform_sphere(u: Tensor) -> Tensor:
    """Directions ``(3, N)`` with density ``1 / 4 pi``."""
    z = 1.0 - 2.0 * u[0]
    r = 2.0 * (u[0] * (1.0 - u[0])).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), z))


def one_minus_cos(sin2: Tensor) -> Tensor:
    """``1 - sqrt(1 - sin2)`` without cancellation: a series below ``sin2 = 6.9e-4``, where a far light's cone vanishes."""
    series = sin2 * (0.5 + sin2 * (0.125 + sin2 * 0.0625))
    return torch.where(sin2 < 6.9e-4, series, 1.0 - (1.0 - sin2).clamp_min(0.0).sqrt())


def uniform_cone(u: Tensor, width: Tensor) -> Tensor:
    """Directions ``(3, N)`` about ``+z`` within a cone of ``width = 1 - cos(theta_max)``; density ``1 / (2 pi width)``."""
    drop = u[0] * width  # 1 - cos(theta)
    r = (drop * (2.0 - drop)).clamp_min(0.0).sqrt()
    phi = (2.0 * math.pi) * u[1]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), 1.0 - drop))


def uniform_triangle(u: Tensor) -> Tensor:
    """Barycentrics ``(2, N)`` of points uniform by area (Heitz, *A Low-Distortion Map Between Triangle and Square*, 2019)."""
    a, b = u[0], u[1]
    low = torch.minimum(a, b) * 0.5
    return torch.stack((a, b)) - low
