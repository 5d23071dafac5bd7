"""Phong's reflection in its modified form: Lafortune and Willems, *Using the Modified Phong Reflectance Model*, 1994.

``f = kd / pi + ks (n + 2) / (2 pi) cos^n a``, where ``a`` is the angle between ``wi`` and the mirror direction of ``wo``,
``n`` the exponent, ``kd`` and ``ks`` the parameters ``diffuse`` and ``specular``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import Frame, dot
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

__all__ = ["Phong"]


@dataclass(frozen=True)
class Phong(PhongBase):
    """Lambert and a lobe about the mirror direction; it conserves energy where `diffuse + specular <= 1`."""

    name = "phong"

    def prepare(self, values: Parameters) -> Parameters:
        """Add ``lobe_probability``, the probability of the diffuse lobe."""
        return {**values, "lobe_probability": lobe_probability(mean(values["diffuse"]), mean(values["specular"]))}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        exponent, diffuse_probability = parameters["exponent"], parameters["lobe_probability"]
        seen = in_upper_hemisphere(wo, wi)  # 1 or 0
        cosine = wi[2] * seen
        off = torch.stack((wo[0] + wi[0], wo[1] + wi[1], wo[2] - wi[2]))  # from the mirror direction to wi
        # Half the squared distance of two unit vectors is 1 - cos of the angle between them.
        peak = cosine_power(0.5 * dot(off, off), exponent) * (0.5 / math.pi)
        value = torch.addcmul(
            parameters["diffuse"] * (cosine * (1.0 / math.pi)), parameters["specular"], (exponent + 2.0) * peak * cosine
        )
        pdf = (
            diffuse_probability * cosine * (1.0 / math.pi)
            + (1.0 - diffuse_probability) * (exponent + 1.0) * peak * seen
        )
        return value, pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Choose a lobe by mean reflectance; a ``wi`` below the surface fails."""
        assert lobe is not None
        one_minus_cos = sample_cosine_power(u[0], parameters["exponent"])
        r = (one_minus_cos * (2.0 - one_minus_cos)).clamp_min(0.0).sqrt()  # sine of the angle
        phi = (2.0 * math.pi) * u[1]
        frame = Frame.about(torch.stack((-wo[0], -wo[1], wo[2])))
        glossy = frame.to_world(torch.stack((r * torch.cos(phi), r * torch.sin(phi), 1.0 - one_minus_cos)))
        wi = torch.where(lobe < parameters["lobe_probability"], cosine_hemisphere(u), glossy)
        return mixture_sample(self, parameters, wo, wi)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the sum of both reflectances."""
        return parameters["diffuse"] + parameters["specular"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return facets of exponent ``4 n``: about the half vector they are as wide as a lobe about the mirror direction."""
        # A lobe cos^n about the half vector is as wide as GGX of alpha^2 = 2 / (n + 2).
        return phong_split_sum(parameters, alpha2=2.0 / (4.0 * parameters["exponent"] + 2.0), peak=1.0)
