"""A diffuse base under GGX facets whose masking is the shortcut ``G1(v) = nv / (nv (1 - k) + k)``, ``k = (r + 1)^2 / 8``.

Karis, *Real Shading in Unreal Engine 4*, 2013. Two models share it and differ in how much each lobe reflects.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.bsdfs.lobes import above, mean, share, weighed, with_delta
from torchpt.math import microfacet
from torchpt.math.warps import cosine_hemisphere
from torchpt.records import BsdfSample

__all__ = ["Glossy"]


class Glossy(Bsdf):
    """``f = diffuse / pi + specular D G / (4 cos_o cos_i)``; a subclass says how much of each at ``wo``."""

    lobed = True
    delta = True

    def amounts(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Diffuse and specular factors ``(3, N)``."""
        raise NotImplementedError

    def roughness(self, parameters: Parameters) -> Tensor:
        """Roughness ``(N,)`` of the facets; 0 where they are a mirror."""
        return torch.where(parameters["smooth"], 0.0, parameters["alpha"].sqrt())

    def prepare(self, values: Parameters) -> Parameters:
        """Roughness becomes ``alpha`` and ``k``; below the least alpha the facets are a mirror."""
        values = dict(values)
        roughness = values.pop("roughness")
        alpha = roughness * roughness
        return {
            **values,
            "smooth": microfacet.is_smooth(alpha),
            "alpha": microfacet.roughness(alpha),
            "k": (roughness + 1.0) * (roughness + 1.0) * 0.125,
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        alpha, k = parameters["alpha"], parameters["k"]
        rough = torch.logical_not(parameters["smooth"]).to(wo.dtype)
        diffuse, specular = self.amounts(parameters, wo)
        often = share(mean(diffuse), mean(specular))
        cos_o, cos_i = wo[2].clamp_min(0.0), wi[2].clamp_min(0.0)
        facets = microfacet.reflection(wo, wi, alpha, alpha, microfacet.BOUNDED)
        # The shortcut in place of Smith's masking.
        smith = (cos_o + microfacet.stretched_length(wo, alpha, alpha)) * (
            cos_i + microfacet.stretched_length(wi, alpha, alpha)
        )
        peak = facets.value * rough * smith / (4.0 * (cos_o - cos_o * k + k) * (cos_i - cos_i * k + k))
        cosine = cos_i * above(wo, wi) * (1.0 / math.pi)
        return torch.addcmul(diffuse * cosine, specular, peak), often * cosine + (1.0 - often) * facets.pdf * rough

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """One of the lobes by what they would reflect, the facets by visible normals."""
        assert lobe is not None
        alpha = parameters["alpha"]
        diffuse, specular = self.amounts(parameters, wo)
        often = share(mean(diffuse), mean(specular))
        shiny = lobe >= often
        m = microfacet.sample_normal(wo, alpha, alpha, u, microfacet.BOUNDED)
        about = microfacet.reflect(wo, m, wo[0] * m[0] + wo[1] * m[1] + wo[2] * m[2])
        drawn = weighed(self, parameters, wo, torch.where(shiny, about, cosine_hemisphere(u)))
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        masking = wo[2] / (wo[2] - wo[2] * parameters["k"] + parameters["k"])
        weight = specular * (masking * masking / torch.where(shiny, 1.0 - often, 1.0))
        return with_delta(drawn, shiny & parameters["smooth"] & (wo[2] > 0), mirror, weight)
