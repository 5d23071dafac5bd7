"""Polished boundaries between two clear media: one of them, and a thin pane of two."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.math.fresnel import fresnel_dielectric
from torchpt.records import BsdfSample

__all__ = ["Dielectric", "choose", "clear", "tinted"]


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


@dataclass(frozen=True)
class Dielectric(Bsdf):
    """Reflection and refraction, chosen by the reflectance."""

    name = "dielectric"
    parameters = {  # noqa: RUF012
        "int_ior": 1.5046,
        "ext_ior": 1.000277,
        "specular_reflectance": (1.0, 1.0, 1.0),
        "specular_transmittance": (1.0, 1.0, 1.0),
    }
    lobed = True
    delta = True
    smooth = True
    transmits = True
    refracts = True

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        return clear(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing: a delta is not seen."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """The mirror image, or the refracted ray."""
        assert lobe is not None
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

    def albedo(self, parameters: Parameters) -> Tensor:
        """White: what it takes is what it gives."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)
