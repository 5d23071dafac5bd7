"""A diffuse base under a rough clear coat, with all reflections between the two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.microfacet import fresnel_dielectric
from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, Values
from torchpt.physics.bsdfs.lobes import (
    Coat,
    coat_parameters,
    coated_split_sum,
    lobe_probability,
    mixture_sample,
    tinted,
    with_delta,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import Rough, mean_roughness, rough

__all__ = ["RoughPlastic"]

_ENTRIES = 64  # cosines of the tables, as Mitsuba has them


@dataclass(frozen=True)
class RoughPlastic(Rough, Coat):
    """A coat with GGX microfacets over a diffuse base.

    A row with a roughness below ``1e-4`` has a mirror for a coat. What the coat lets through is tabulated for each material
    over the cosine of a direction.

    Attributes:
        nonlinear: light that the coat throws back takes the base's colour again.
    """

    name = "roughplastic"
    tabulated = ("alpha", "roughness", "int_ior", "ext_ior")
    lobed = True
    delta = True

    nonlinear: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(values["nonlinear"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`."""
        return cls(), cls(nonlinear=True)

    def tabulate(self, values: Parameters) -> Parameters:
        """How much the coat lets through by cosine, and how much of the base's light it sends back."""
        eta = values["int_ior"] / values["ext_ior"]
        surface = rough(values, False)
        cosines = torch.linspace(0, 1, _ENTRIES, dtype=torch.float64, device=eta.device).clamp_min(1e-6)
        alpha, index = surface["alpha_u"].double(), eta.double()
        through = microfacet.coat_transmittance(cosines, alpha, index)
        inner = microfacet.coat_reflectance(cosines, alpha, 1.0 / index)
        diffuse = 2.0 * (inner * cosines).mean()[None].to(eta.dtype)
        return {"transmittance": Table(through.to(eta.dtype), _ENTRIES), "inner": diffuse}

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        tables = values if "transmittance" in values else self.tabulate(values)
        return {
            **coat_parameters(values, values["int_ior"] / values["ext_ior"], 1.0 - tables["inner"], self.nonlinear),
            **rough(values, False),
            "transmittance": tables["transmittance"],
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """The coat, and the base seen through the coat both ways."""
        alpha = parameters["alpha_u"]
        at = microfacet.reflection(wo, wi, alpha, alpha, bounded=microfacet.BOUNDED)
        f = fresnel_dielectric(at.cos_m, parameters["eta"]).reflectance
        t_o, t_i = parameters["transmittance"].at(wo[2]), parameters["transmittance"].at(wi[2])
        rough_coat = (~parameters["smooth"]).to(wo.dtype)
        cosine = wi[2].clamp_min(0.0) * (1.0 / math.pi) * wo[2].sign().clamp_min(0.0)
        coat = tinted(f * at.value * rough_coat, parameters["specular_reflectance"])
        specular = self._specular(parameters, t_o)
        pdf = specular * (at.pdf * rough_coat) + (1.0 - specular) * cosine
        return torch.addcmul(coat, parameters["base"], t_o * t_i * cosine), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at a visible normal, or about the surface's."""
        assert lobe is not None
        alpha, smooth = parameters["alpha_u"], parameters["smooth"]
        through = parameters["transmittance"].at(wo[2])
        specular = self._specular(parameters, through)
        chosen = lobe < specular
        m = microfacet.sample_normal(wo, alpha, alpha, u, microfacet.BOUNDED)
        wi = torch.where(chosen, microfacet.reflect(wo, m, dot(wo, m)), cosine_hemisphere(u))
        drawn = mixture_sample(self, parameters, wo, wi)
        # Under a mirror, what the table says is let through is not reflected as well.
        f_o = torch.minimum(fresnel_dielectric(wo[2], parameters["eta"]).reflectance, 1.0 - through)
        metal_split_sum = torch.stack((-wo[0], -wo[1], wo[2]))
        weight = tinted(f_o / torch.where(specular > 0, specular, 1.0), parameters["specular_reflectance"])
        return with_delta(drawn, chosen & smooth & (wo[2] > 0), metal_split_sum, weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """That of the base."""
        return parameters["diffuse_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A rough mirror over the base."""
        return coated_split_sum(parameters, mean_roughness(parameters))

    def _specular(self, parameters: Parameters, t_o: Tensor) -> Tensor:
        """How often the coat is chosen."""
        weight = parameters["specular_share"]
        return lobe_probability((1.0 - t_o) * weight, t_o * (1.0 - weight))
