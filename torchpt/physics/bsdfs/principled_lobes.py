"""The pieces of the principled model that no other has: Schlick's weight, tints, its diffuse and sheen lobes, its clearcoat.

Burley, *Physically Based Shading at Disney*, 2012 (below: 2012), and *Extending the Disney BRDF to a BSDF with Integrated
Subsurface Scattering*, 2015 (below: 2015).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchpt.math.microfacet import Interface, ggx, masking, stretched_length
from torchpt.math.vectors import luminance

__all__ = [
    "Facet",
    "MainLobes",
    "Probabilities",
    "clearcoat_alpha",
    "clearcoat_masking",
    "fake_subsurface",
    "flip_to_upper",
    "gtr1",
    "lerp",
    "or_zero",
    "retro_diffuse",
    "sample_gtr1",
    "schlick_weight",
    "tint",
    "up",
    "wide_ggx",
]


class Facet(NamedTuple):
    """What happens at one facet; ``wo`` has been turned to the upper side."""

    interface: Interface  # with the far side's index over that of wo's side
    cos: Tensor  # (N,) of wo and the facet's normal, >= 0
    schlick: Tensor  # (N,) Schlick's weight there
    reflected: Tensor  # (3, N)
    refracted: Tensor | None  # (3, N), without the radiance factor; None where nothing refracts


class Probabilities(NamedTuple):
    """Of drawing each lobe, each ``(N,)`` and detached. Only how the last two share their sum depends on the facet."""

    diffuse: Tensor
    clearcoat: Tensor | None
    reflect: Tensor
    refract: Tensor | None


class MainLobes(NamedTuple):
    """The main lobes between ``wo`` and ``wi`` as if all were reflected, and all refracted; each ``(N,)``."""

    m: Tensor  # (3, N) half vector
    cos: Tensor  # of wo and m, >= 0
    reflection: Tensor  # f cos(theta_i)
    reflection_pdf: Tensor
    refraction: Tensor  # the last two are those of reflection, and idle, where nothing refracts
    refraction_pdf: Tensor


def lerp(a: Tensor | float, b: Tensor | float, t: Tensor) -> Tensor:
    """``a`` at 0, ``b`` at 1."""
    return a + t * (b - a)


def schlick_weight(cos: Tensor) -> Tensor:
    """``(1 - cos)^5`` (Schlick 1994)."""
    x = (1.0 - cos).clamp(0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def tint(base_color: Tensor) -> Tensor:
    """The colour at luminance 1, white where it is black: ``(3, N) -> (3, N)``."""
    y = luminance(base_color)
    lit = y > 0
    return torch.where(lit, base_color / torch.where(lit, y, 1.0), 1.0)


def retro_diffuse(roughness: Tensor, fresnel_o: Tensor, fresnel_i: Tensor, cos_d: Tensor) -> Tensor:
    """Diffuse with retro-reflection, times pi, in the form of 2015, section 3: ``(N,)``.

    Args:
        roughness: ``(N,)``.
        fresnel_o: Schlick's weight at ``wo``.
        fresnel_i: the same at ``wi``.
        cos_d: of the angle between either and the half vector.
    """
    retro = 2.0 * roughness * cos_d * cos_d
    both = fresnel_o * fresnel_i
    return (1.0 - 0.5 * fresnel_o) * (1.0 - 0.5 * fresnel_i) + retro * (fresnel_o + fresnel_i + both * (retro - 1.0))


def fake_subsurface(
    roughness: Tensor, fresnel_o: Tensor, fresnel_i: Tensor, cos_d: Tensor, cos_o: Tensor, cos_i: Tensor
) -> Tensor:
    """The lobe that stands in for scattering below the surface, times pi (2012, section 5.3, after Hanrahan and Krueger)."""
    grazing = roughness * cos_d * cos_d
    both = lerp(1.0, grazing, fresnel_o) * lerp(1.0, grazing, fresnel_i)
    sum_ = cos_o + cos_i
    apart = sum_ > 0
    return 1.25 * (both * (1.0 / torch.where(apart, sum_, 1.0) - 0.5) + 0.5)


def clearcoat_alpha(gloss: Tensor) -> Tensor:
    """Roughness of the coat: 0.1 at gloss 0, 0.001 at gloss 1."""
    return lerp(0.1, 0.001, gloss)


def gtr1(m: Tensor, alpha: Tensor) -> Tensor:
    """Density of normals, with a longer tail than GGX: 2012, appendix B.2, equation 4; the bracket has no cancellation."""
    a2 = alpha * alpha
    bracket = torch.addcmul(torch.addcmul(m[0] * m[0], m[1], m[1]), a2 * m[2], m[2])
    return (a2 - 1.0) / (math.pi * torch.log(a2) * bracket)


def sample_gtr1(alpha: Tensor, u: Tensor) -> Tensor:
    """Normals ``(3, N)`` with density ``D cos`` (2012, appendix B.2, equation 2)."""
    a2 = alpha * alpha
    sin2 = a2 * torch.expm1(-u[1] * torch.log(a2)) / (1.0 - a2)
    sin2 = sin2.clamp(0.0, 1.0)
    r, phi = sin2.sqrt(), (2.0 * math.pi) * u[0]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), (1.0 - sin2).sqrt()))


def clearcoat_masking(wo: Tensor, wi: Tensor, cos_o: Tensor, cos_i: Tensor) -> Tensor:
    """Smith's product for a fixed roughness of 0.25 (2012, section 5.6); positive cosines ``(N,)``."""
    alpha = torch.full_like(cos_o, 0.25)
    return masking(cos_o, stretched_length(wo, alpha, alpha)) * masking(cos_i, stretched_length(wi, alpha, alpha))


def wide_ggx(m: Tensor, alpha_u: Tensor, alpha_v: Tensor) -> Tensor:
    """GGX where full anisotropy makes a rough surface still rougher along one axis: alpha up to 3.2.

    :func:`~torchpt.math.microfacet.ggx` takes roughnesses up to 1. In units of the largest, heights are as much greater,
    and so is the density by its square.
    """
    unit = torch.maximum(alpha_u, alpha_v).clamp_min(1.0)
    return unit * unit * ggx(torch.stack((m[0], m[1], m[2] * unit)), alpha_u / unit, alpha_v / unit)


def up(like: Tensor) -> Tensor:
    """The normal in every lane: what stands in where there is no half vector."""
    zero = torch.zeros_like(like[0])
    return torch.stack((zero, zero, torch.ones_like(zero)))


def or_zero(value: Tensor | None, like: Tensor) -> Tensor:
    """A feature's amount, 0 where it is absent."""
    return torch.zeros_like(like) if value is None else value


def flip_to_upper(wo: Tensor, wi: Tensor, eta: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The pair turned so that ``wo`` is above, the far side's index over the near one's, and 1 where nothing was turned."""
    side = torch.copysign(torch.ones_like(wo[2]), wo[2])
    front = (side > 0).to(side.dtype)
    wo, wi = (torch.stack((w[0], w[1], w[2] * side)) for w in (wo, wi))
    return wo, wi, torch.where(side > 0, eta, 1.0 / eta), front
