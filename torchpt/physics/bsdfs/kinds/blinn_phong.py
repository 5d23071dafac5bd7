"""Blinn's model with Phong's normalization, as published: ``f = kd / pi + ks (n + 2) / (2 pi) (h . n)^n``.

Blinn, *Models of Light Reflection for Computer Synthesized Pictures*, 1977. It creates energy: at normal incidence the
specular lobe alone reflects up to ``4 ks``. ``h`` is the half vector, ``n`` the exponent (within ``h . n`` the normal), ``kd``
and ``ks`` are the parameters ``diffuse`` and ``specular``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.lobes import (
    PhongBase,
    cosine_power,
    in_upper_hemisphere,
    lobe_probability,
    mean,
    mixture_sample,
    phong_split_sum,
    sample_cosine_power,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import reflectance

__all__ = ["BlinnPhong"]


@dataclass(frozen=True)
class BlinnPhong(PhongBase):
    """Lambert and a lobe about the half vector, as published: it reflects up to `diffuse + 4 specular`."""

    name = "blinn_phong"
    parameters: ClassVar = {
        "specular": reflectance(
            (0.1, 0.1, 0.1), "reflectance of the glossy lobe: it reflects up to four times as much where it is sharp"
        )
    }
    max_albedo = 4.0
    conserves = False

    def prepare(self, values: Parameters) -> Parameters:
        """Add ``lobe_probability``: the probability of the diffuse lobe by albedos at normal incidence.

        There ``(n + 2) / (2 pi) (h . n)^n`` integrates to ``4 (n + 2^(-n/2)) / (n + 4)``: from 1 at ``n = 0`` to 4.
        """
        n = values["exponent"]
        peak = 4.0 * (n + torch.exp(-0.5 * math.log(2.0) * n)) / (n + 4.0)
        return {
            **values,
            "lobe_probability": lobe_probability(mean(values["diffuse"]), mean(values["specular"]) * peak),
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        exponent, diffuse_probability = parameters["exponent"], parameters["lobe_probability"]
        seen = in_upper_hemisphere(wo, wi)  # 1 or 0
        cosine = wi[2] * seen
        s = wo + wi  # along the half vector, 2 cos(wo, h) long
        square = dot(s, s)
        usable = square > 0
        square = torch.where(usable, square, 1.0)
        # (h . n)^n = (1 - sin^2)^(n/2), with the sine between h and the normal
        peak = cosine_power((s[0] * s[0] + s[1] * s[1]) / square, 0.5 * exponent) * usable * (0.5 / math.pi)
        value = torch.addcmul(
            parameters["diffuse"] * (cosine * (1.0 / math.pi)), parameters["specular"], (exponent + 2.0) * peak * cosine
        )
        pdf = diffuse_probability * cosine * (1.0 / math.pi) + (1.0 - diffuse_probability) * (
            exponent + 1.0
        ) * peak * seen / (2.0 * square.sqrt())
        return value, pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Choose a lobe; the half vector has density ``(n + 1) / (2 pi) (h . n)^n``. A ``wi`` below the surface fails."""
        assert lobe is not None
        one_minus_cos = sample_cosine_power(u[0], parameters["exponent"])
        r = (one_minus_cos * (2.0 - one_minus_cos)).clamp_min(0.0).sqrt()  # sine between h and the normal
        phi = (2.0 * math.pi) * u[1]
        h = torch.stack((r * torch.cos(phi), r * torch.sin(phi), 1.0 - one_minus_cos))
        wi = torch.where(lobe < parameters["lobe_probability"], cosine_hemisphere(u), h * (2.0 * dot(wo, h)) - wo)
        return mixture_sample(self, parameters, wo, wi)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the sum of both reflectances, at most 1."""
        return (parameters["diffuse"] + parameters["specular"]).clamp_max(1.0)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return facets of GGX alpha ``sqrt(2 / (n + 2))``, with the lobe's albedo at normal incidence."""
        n = parameters["exponent"]
        peak = 4.0 * (n + torch.exp(-0.34657359 * n)) / (n + 4.0)  # as in `prepare`: 0.34657359 is log(2) / 2
        return phong_split_sum(parameters, alpha2=2.0 / (n + 2.0), peak=peak)
