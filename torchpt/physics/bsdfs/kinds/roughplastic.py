"""A diffuse base under a rough clear coat, with all reflections between the two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.diffuse_coat import diffuse_reflectance, normal_reflectance
from torchpt.math.microfacet import fresnel_dielectric
from torchpt.math.sampling import cosine_hemisphere
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Table, Values
from torchpt.physics.bsdfs.kept_tables import keep_tables
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
from torchpt.physics.bsdfs.rough import Rough, mean_roughness, roughness_parameters

__all__ = ["RoughPlastic"]

_COSINES = 64  # entries of the tables, as in Mitsuba


@dataclass(frozen=True)
class RoughPlastic(Rough, Coat):
    """A coat with microfacets over a diffuse base.

    A row with alpha below ``1e-4`` has a smooth coat. The transmittance of the coat is tabulated for each material, over the
    cosine of a direction.

    Attributes:
        beckmann: the distribution is Beckmann's, not GGX.
        nonlinear: internally reflected light is multiplied by the base's colour again.
    """

    name = "roughplastic"
    tabulated = ("alpha", "roughness", "int_ior", "ext_ior")
    lobed = True  # `sample` reads a number `lobe`, which chooses between coat and base
    delta = True

    beckmann: bool = False
    nonlinear: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        return cls(beckmann=values["distribution"] == "beckmann", nonlinear=values["nonlinear"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        return cls(), cls(nonlinear=True), cls(beckmann=True)

    @keep_tables
    def tabulate(self, values: Parameters) -> Parameters:
        """Return the coat's ``transmittance`` by cosine, and ``inner``, its mean reflectance for diffuse light from below."""
        eta = values["int_ior"] / values["ext_ior"]
        surface = roughness_parameters(values, anisotropic=False)
        cosines = torch.linspace(0, 1, _COSINES, dtype=torch.float64, device=eta.device).clamp_min(1e-6)
        alpha, index = surface["alpha_u"].double(), eta.double()
        transmittance = microfacet.coat_transmittance(cosines, alpha, index, self.facets)
        inner = self._inner(cosines, alpha, 1.0 / index)
        return {"transmittance": Table(transmittance.to(eta.dtype), count=_COSINES), "inner": inner.to(eta.dtype)}

    def _inner(self, cosines: Tensor, alpha: Tensor, index: Tensor) -> Tensor:
        """Return the coat's mean reflectance ``(1,)`` for diffuse light from below.

        It is Mitsuba's mean of ``2 R cos`` over equidistant cosines, both ends included. That sum is not smooth in the index,
        as total internal reflection begins between two of them. The Euler-Maclaurin formula gives it from the integral.

        Args:
            cosines: ``(K,)``.
            alpha: ``(1,)``.
            index: ``(1,)`` of the outside over that of the coat.
        """
        intervals = len(cosines) - 1
        integral = diffuse_reflectance(alpha, index, self.facets)
        along = normal_reflectance(alpha, index, self.facets)
        ends = [0, -3, -2, -1]
        first, before, last, end = microfacet.coat_reflectance(cosines[ends], alpha, index, self.facets) * cosines[ends]
        slope = (1.5 * end - 2.0 * last + 0.5 * before) * intervals - first / cosines[0]  # of R cos, from end to end
        return (intervals * (integral + slope / (6.0 * intervals**2)) + along) / len(cosines)

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters of one material, or of all lanes, from its values; see :meth:`Bsdf.prepare`."""
        tables = values if "transmittance" in values else self.tabulate(values)
        return {
            **coat_parameters(
                values, values["int_ior"] / values["ext_ior"], 1.0 - tables["inner"], nonlinear=self.nonlinear
            ),
            **roughness_parameters(values, anisotropic=False),
            "transmittance": tables["transmittance"],
        }

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return the coat, and the base attenuated by the coat on the way in and out."""
        alpha = parameters["alpha_u"]
        facets = self.facets.reflection(wo, wi, alpha, alpha, bounded=microfacet.BOUNDED)
        f = fresnel_dielectric(facets.cos_m, parameters["eta"]).reflectance
        t_o, t_i = parameters["transmittance"].at(wo[2]), parameters["transmittance"].at(wi[2])
        # 1, or 0 where the coat is a mirror: `eval` leaves deltas out.
        rough_coat = (~parameters["smooth"]).to(wo.dtype)
        # Over pi; 0 where wo is not above the surface.
        cosine = wi[2].clamp_min(0.0) * (1.0 / math.pi) * wo[2].sign().clamp_min(0.0)
        coat = tinted(f * facets.value * rough_coat, parameters["specular_reflectance"])
        coat_probability = self._coat_probability(parameters, t_o)
        pdf = coat_probability * (facets.pdf * rough_coat) + (1.0 - coat_probability) * cosine
        return torch.addcmul(coat, parameters["base"], t_o * t_i * cosine), pdf

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at a visible normal of the coat, or sample the base by the cosine."""
        assert lobe is not None
        alpha, smooth = parameters["alpha_u"], parameters["smooth"]
        t_o = parameters["transmittance"].at(wo[2])
        coat_probability = self._coat_probability(parameters, t_o)
        chosen = lobe < coat_probability
        m = self.facets.sample_normal(wo, alpha, alpha, u, bounded=microfacet.BOUNDED)
        wi = torch.where(chosen, microfacet.reflect(wo, m, dot(wo, m)), cosine_hemisphere(u))
        drawn = mixture_sample(self, parameters, wo, wi)
        # Keeps reflectance and tabulated transmittance of a smooth coat from adding up to more than 1.
        f_o = torch.minimum(fresnel_dielectric(wo[2], parameters["eta"]).reflectance, 1.0 - t_o)
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        weight = tinted(
            f_o / torch.where(coat_probability > 0, coat_probability, 1.0), parameters["specular_reflectance"]
        )
        return with_delta(drawn, chosen & smooth & (wo[2] > 0), mirror, weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the albedo of the base."""
        return parameters["diffuse_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a rough mirror over the base."""
        return coated_split_sum(parameters, mean_roughness(parameters))

    def _coat_probability(self, parameters: Parameters, t_o: Tensor) -> Tensor:
        """Return the probability of choosing the coat ``(N,)``, for its transmittance ``t_o (N,)`` at ``wo``."""
        weight = parameters["coat_weight"]
        return lobe_probability((1.0 - t_o) * weight, t_o * (1.0 - weight))
