"""What boundaries between clear media share: their indices and tints, the choice of a side, a polished boundary."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.bsdfs.presets import INDICES
from torchpt.bsdfs.specs import index, reflectance
from torchpt.math.fresnel import fresnel_dielectric
from torchpt.records import BsdfSample, SplitSumMaterial

__all__ = ["Glass", "choose", "clear", "passing", "polished", "tinted"]


class Glass(Bsdf, part=True):
    """A part of a model: two media, and factors of what is reflected and of what passes."""

    parameters: ClassVar = {
        "int_ior": index(INDICES["bk7"], "index of refraction behind the normal"),
        "ext_ior": index(INDICES["air"], "index of refraction in front of it"),
        "specular_reflectance": reflectance(None, "a tint: a factor of what is reflected; 1 where it is not said"),
        "specular_transmittance": reflectance(None, "the same of what passes"),
    }


def clear(values: Parameters) -> Parameters:
    """What clear boundaries read: ``eta``, the index below over that above, and the factors, or None."""
    tints = {name: values.get(name) for name in ("specular_reflectance", "specular_transmittance")}
    return {"eta": values["int_ior"] / values["ext_ior"], **tints}


def tinted(amount: Tensor, tint: Tensor | None) -> Tensor:
    """An amount ``(N,)`` as a colour ``(3, N)``, by a factor that may be absent."""
    return amount.expand(3, -1) if tint is None else amount * tint


def choose(reflectance: Tensor, lobe: Tensor) -> tuple[Tensor, Tensor]:
    """Whether to reflect, and the weight ``(N,)`` of what was chosen: 1, with the derivative of its amount."""
    r = reflectance.detach()
    reflects = lobe < r
    amount = torch.where(reflects, reflectance, 1.0 - reflectance)
    probability = torch.where(reflects, r, 1.0 - r)
    return reflects, amount / torch.where(probability > 0, probability, 1.0)


def polished(parameters: Parameters, wo: Tensor, lobe: Tensor) -> BsdfSample:
    """The mirror image, or the refracted ray, at a smooth boundary."""
    side = fresnel_dielectric(wo[2], parameters["eta"], torch.addcmul(wo[0] * wo[0], wo[1], wo[1]))
    reflects, share = choose(side.reflectance, lobe)
    # Nothing is refracted under total internal reflection, where the reflectance is 1.
    sideways = torch.where(reflects, -1.0, -side.eta_ti)
    wi = torch.stack((wo[0] * sideways, wo[1] * sideways, torch.where(reflects, wo[2], side.cos_t)))
    weight = torch.where(
        reflects,
        tinted(share, parameters["specular_reflectance"]),
        tinted(share * side.eta_ti * side.eta_ti, parameters["specular_transmittance"]),
    )
    return BsdfSample(
        wi,
        torch.where(wo[2] != 0, math.inf, 0.0).to(wo.dtype),
        weight,
        torch.where(reflects, 1.0, side.eta_it).detach(),
    )


def passing(parameters: Parameters, roughness: Tensor, f0: Tensor, eta: Tensor | None) -> SplitSumMaterial:
    """A clear boundary in the preview.

    Args:
        parameters: lane values.
        roughness: ``(N,)``.
        f0: reflectance at normal incidence ``(N,)``.
        eta: index below over that above ``(N,)``; None where nothing is bent.
    """
    one = torch.ones_like(f0)
    reflects, passes = parameters["specular_reflectance"], parameters["specular_transmittance"]
    return SplitSumMaterial(
        torch.zeros_like(one).expand(3, -1),
        tinted(f0, reflects),
        tinted(one, reflects),
        roughness,
        f0,
        tinted(one, passes),
        eta,
    )
