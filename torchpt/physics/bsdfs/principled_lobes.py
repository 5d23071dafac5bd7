"""Terms of the principled BSDF alone: Schlick's weight, tint, the diffuse lobes, the clearcoat.

Main lobes are the GGX reflection and refraction; beside them there are the diffuse lobe (with sheen) and the clearcoat.
"Upper side" is that of the shading normal; all lanes of an opaque model, and those of a transmissive one after
:func:`flip_to_upper`, have ``wo`` there. Cosines, weights and alphas are ``(N,)``, directions and colours ``(3, N)``.

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
    """Reflection and refraction at one facet, for a ``wo`` on the upper side."""

    interface: Interface  # for the index of the far side over the one of wo's side
    cos: Tensor  # (N,) dot(wo, m) >= 0
    schlick: Tensor  # (N,) Schlick's weight for this cosine
    reflected: Tensor  # (3, N) factor of the reflection lobe
    #: (3, N) factor of the refraction lobe, without the 1 / eta^2 of radiance; None: opaque model
    refracted: Tensor | None


class Probabilities(NamedTuple):
    """Probabilities of the lobes, each ``(N,)`` and detached. Only the ratio of the last two depends on the facet."""

    diffuse: Tensor
    clearcoat: Tensor | None  # None: no material of the model has a clearcoat
    reflect: Tensor
    refract: Tensor | None  # None: opaque model


class MainLobes(NamedTuple):
    """Values and densities of the main lobes without Fresnel factors; each ``(N,)``."""

    m: Tensor  # (3, N) half vector
    cos: Tensor  # dot(wo, m) >= 0
    reflection: Tensor  # f cos(theta_i)
    reflection_pdf: Tensor  # per steradian
    refraction: Tensor  # f cos(theta_i); an opaque model repeats the reflection here, unused
    refraction_pdf: Tensor


def lerp(a: Tensor | float, b: Tensor | float, t: Tensor) -> Tensor:
    """Interpolate linearly from ``a`` at ``t`` 0 to ``b`` at ``t`` 1."""
    return a + t * (b - a)


def schlick_weight(cos: Tensor) -> Tensor:
    """Return ``(1 - cos)^5`` (Schlick 1994)."""
    x = (1.0 - cos).clamp(0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def tint(base_color: Tensor) -> Tensor:
    """Return the colour scaled to luminance 1, white for black: ``(3, N) -> (3, N)``."""
    brightness = luminance(base_color)
    is_lit = brightness > 0
    return torch.where(is_lit, base_color / torch.where(is_lit, brightness, 1.0), 1.0)


def retro_diffuse(roughness: Tensor, fresnel_o: Tensor, fresnel_i: Tensor, cos_d: Tensor) -> Tensor:
    """Return the diffuse lobe with retro-reflection, times pi ``(N,)`` (2015, section 3).

    Args:
        roughness: ``(N,)``.
        fresnel_o: Schlick's weight at ``wo``.
        fresnel_i: Schlick's weight at ``wi``.
        cos_d: cosine of the angle between the half vector and ``wo`` or ``wi``.
    """
    retro = 2.0 * roughness * cos_d * cos_d
    both = fresnel_o * fresnel_i
    return (1.0 - 0.5 * fresnel_o) * (1.0 - 0.5 * fresnel_i) + retro * (fresnel_o + fresnel_i + both * (retro - 1.0))


def fake_subsurface(
    roughness: Tensor, fresnel_o: Tensor, fresnel_i: Tensor, cos_d: Tensor, cos_o: Tensor, cos_i: Tensor
) -> Tensor:
    """Return the fake subsurface lobe, times pi ``(N,)`` (2012, section 5.3, after Hanrahan and Krueger).

    Arguments as for :func:`retro_diffuse`; ``cos_o`` and ``cos_i`` are the cosines of ``wo`` and ``wi``, at least 0.
    """
    grazing = roughness * cos_d * cos_d  # value of each factor where its direction grazes the surface
    both = lerp(1.0, grazing, fresnel_o) * lerp(1.0, grazing, fresnel_i)
    cosines = cos_o + cos_i
    usable = cosines > 0
    return 1.25 * (both * (1.0 / torch.where(usable, cosines, 1.0) - 0.5) + 0.5)


def clearcoat_alpha(gloss: Tensor) -> Tensor:
    """Return alpha of the clearcoat: 0.1 at gloss 0, 0.001 at gloss 1 (2012)."""
    return lerp(0.1, 0.001, gloss)


def gtr1(m: Tensor, alpha: Tensor) -> Tensor:
    """Return the GTR1 distribution of normals ``(N,)`` (2012, appendix B.2, equation 4), written without cancellation."""
    a2 = alpha * alpha
    bracket = torch.addcmul(torch.addcmul(m[0] * m[0], m[1], m[1]), a2 * m[2], m[2])
    return (a2 - 1.0) / (math.pi * torch.log(a2) * bracket)


def sample_gtr1(alpha: Tensor, u: Tensor) -> Tensor:
    """Sample normals ``(3, N)`` with density ``D cos`` from ``u (2, N)`` (2012, appendix B.2, equation 2)."""
    a2 = alpha * alpha
    sin2 = a2 * torch.expm1(-u[1] * torch.log(a2)) / (1.0 - a2)
    sin2 = sin2.clamp(0.0, 1.0)
    r, phi = sin2.sqrt(), (2.0 * math.pi) * u[0]
    return torch.stack((r * torch.cos(phi), r * torch.sin(phi), (1.0 - sin2).sqrt()))


def clearcoat_masking(wo: Tensor, wi: Tensor, cos_o: Tensor, cos_i: Tensor) -> Tensor:
    """Return Smith's separable masking for alpha 0.25 (2012, section 5.6); cosines ``(N,)`` are positive."""
    alpha = torch.full_like(cos_o, 0.25)
    return masking(cos_o, stretched_length(wo, alpha, alpha)) * masking(cos_i, stretched_length(wi, alpha, alpha))


def wide_ggx(m: Tensor, alpha_u: Tensor, alpha_v: Tensor) -> Tensor:
    """Return the GGX distribution of normals for alphas above 1: full anisotropy raises them up to 3.2.

    :func:`~torchpt.math.microfacet.ggx` takes alphas up to 1. Divides both by the larger one, which scales the height of
    ``m`` by its inverse and the density by its square.
    """
    unit = torch.maximum(alpha_u, alpha_v).clamp_min(1.0)
    return unit * unit * ggx(torch.stack((m[0], m[1], m[2] * unit)), alpha_u / unit, alpha_v / unit)


def up(like: Tensor) -> Tensor:
    """Return +z ``(3, N)``, shaped as ``like``, to stand for half vectors that do not exist."""
    zero = torch.zeros_like(like[0])
    return torch.stack((zero, zero, torch.ones_like(zero)))


def or_zero(value: Tensor | None, like: Tensor) -> Tensor:
    """Return ``value``, or zeros like ``like`` if it is None."""
    return torch.zeros_like(like) if value is None else value


def flip_to_upper(wo: Tensor, wi: Tensor, eta: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Flip both directions so that ``wo`` is above, and the relative index ``eta``, below over above, with them.

    Returns:
        ``wo`` and ``wi``; the index of the far side over that of ``wo``'s side ``(N,)``; 1 where not flipped, else 0 ``(N,)``.
    """
    side = torch.copysign(torch.ones_like(wo[2]), wo[2])
    front = (side > 0).to(side.dtype)
    wo, wi = (torch.stack((w[0], w[1], w[2] * side)) for w in (wo, wi))
    return wo, wi, torch.where(side > 0, eta, 1.0 / eta), front
