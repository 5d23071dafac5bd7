"""A rough dielectric interface: microfacets that reflect and refract.

Walter, Marschner, Li, Torrance, *Microfacet Models for Refraction through Rough Surfaces*, 2007.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.microfacet import INDEX_MATCHED, fresnel_dielectric, refract
from torchpt.math.vectors import dot, normalize
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.kept_tables import keep_tables
from torchpt.physics.bsdfs.lobes import (
    Glass,
    dielectric_parameters,
    dielectric_split_sum,
    mixture_sample,
    reflectance_at_normal,
    sample_smooth_interface,
    tinted,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import (
    Anisotropic,
    alphas,
    energy_at,
    energy_table,
    mean_roughness,
    roughness_parameters,
)

__all__ = ["RoughDielectric"]


@dataclass(frozen=True)
class RoughDielectric(Anisotropic, Glass):
    """A boundary between two clear media with microfacets: frosted glass.

    A row with both alphas below ``1e-4`` is a smooth interface; with equal indices light passes straight on.

    Attributes:
        beckmann: the distribution is Beckmann's, not GGX.
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
        energy_compensation: scale both lobes of ``wo`` by ``1 / E(wo)``, where E is the directional albedo of single
            scattering (Turquin 2019), with height-correlated masking. Not reciprocal.
    """

    name = "roughdielectric"
    lobed = True  # `sample` reads a number `lobe`, which chooses between reflection and refraction
    delta = True
    transmits = True
    refracts = True

    beckmann: bool = False
    anisotropic: bool = False
    energy_compensation: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        variant = cls(
            beckmann=values["distribution"] == "beckmann",
            anisotropic=values["alpha_u"] is not None,
            energy_compensation=values["energy_compensation"],
        )
        return variant, cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        ggx = [
            cls(anisotropic=anisotropic, energy_compensation=compensated)
            for compensated in (False, True)
            for anisotropic in (False, True)
        ]
        beckmann = (
            cls(beckmann=True),
            cls(beckmann=True, anisotropic=True),
            cls(beckmann=True, energy_compensation=True),
        )
        return *ggx, *beckmann

    @keep_tables
    def tabulate(self, values: Parameters) -> Parameters:
        """Return the table of directional albedo for energy compensation, one block for each side."""
        if not self.energy_compensation:
            return {}
        surface = self._surface(values)
        # A smooth material does not read the table: any index but 1, for which the integral would fail, will do.
        eta = torch.where(surface["smooth"], 1.5, surface["eta"])
        return {"energy": energy_table(surface, etas=[eta, 1.0 / eta], facets=self.facets)}

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters of one material, or of all lanes, from its values; see :meth:`Bsdf.prepare`."""
        tables = values if "energy" in values else self.tabulate(values)
        return {**self._surface(values), **({"energy": tables["energy"]} if self.energy_compensation else {})}

    def _surface(self, values: Parameters) -> Parameters:
        """Return the parameters of the interface and of its facets, without the table."""
        out = {**dielectric_parameters(values), **roughness_parameters(values, anisotropic=self.anisotropic)}
        # MicrofacetDistribution between equal indices do not bend light.
        out["smooth"] = out["smooth"] | ((out["eta"] - 1.0).abs() < INDEX_MATCHED)
        return out

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return equations 20 and 21 of Walter et al., and the densities of equations 14 and 17 with visible normals."""
        alpha_u, alpha_v = alphas(parameters)
        eta = parameters["eta"]
        reflects = wo[2] * wi[2] > 0
        eta_it = torch.where(wo[2] > 0, eta, 1.0 / eta)  # the far side's index over that of wo's side
        # h is along the facet's normal m, which points to the upper side.
        h = torch.addcmul(wo, wi, torch.where(reflects, 1.0, eta_it))
        m = normalize(h)
        m = m * torch.copysign(torch.ones_like(m[2]), m[2])
        o, i = dot(wo, m), dot(wi, m)  # cosines at the facet
        # A facet is visible only from the side of the surface on which the direction lies.
        is_visible = torch.minimum(o * wo[2], i * wi[2]) > 0
        counts = is_visible & ~parameters["smooth"]  # deltas are left out
        side = fresnel_dielectric(o, eta)
        seen = self.facets.masking_terms(wo, wi, alpha_u, alpha_v, by_height=self.energy_compensation)
        h2 = dot(h, h)
        # Jacobian dm / dwi, times the cosine o of the density of visible normals, which the next line leaves out:
        # 1 / (4 o) and eta^2 i / |wo + eta wi|^2, the latter without eta^2, which the last line has.
        refraction_jacobian = (o * i).abs() / torch.where(counts, h2, 1.0)
        jacobian = torch.where(reflects, 0.25, refraction_jacobian)
        # Density of wi by reflection or refraction at visible normals.
        normals = self.facets.density(m, alpha_u, alpha_v)
        density = torch.where(counts, normals / seen.area * jacobian, 0.0)
        r = side.reflectance
        value = density * seen.shadowing
        if self.energy_compensation:
            value = value / energy_at(parameters["energy"], parameters, wo, block=(wo[2] < 0).to(wo.dtype))
        colour = torch.where(
            reflects,
            tinted(r * value, parameters["specular_reflectance"]),
            tinted((1.0 - r) * value, parameters["specular_transmittance"]),
        )
        return colour, density * torch.where(reflects, r, (1.0 - r) * (eta_it * eta_it))

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Sample a visible normal, then reflect or refract by its Fresnel reflectance."""
        assert lobe is not None
        smooth = parameters["smooth"]
        sign = torch.copysign(torch.ones_like(wo[2]), wo[2])
        # Normals point to the upper side; -wo sees from above the facets that wo sees from below.
        m = self.facets.sample_normal(wo * sign, *alphas(parameters), u)
        o = dot(wo, m)  # cosine at the facet, negative from below
        side = fresnel_dielectric(o, parameters["eta"])
        reflects = lobe < side.reflectance
        wi = torch.where(reflects, microfacet.reflect(wo, m, o), normalize(refract(wo, m, o, side)))
        # A reflected ray may end up below the surface, a refracted one above it: such samples fail.
        valid = ((wi[2] * wo[2] > 0) == reflects).to(wo.dtype)
        drawn = mixture_sample(self, parameters, wo, wi, valid)
        delta = sample_smooth_interface(parameters, wo, lobe)
        assert delta.eta is not None
        return BsdfSample(
            wi=torch.where(smooth, delta.wi, drawn.wi),
            pdf=torch.where(smooth, delta.pdf, drawn.pdf),
            weight=torch.where(smooth, delta.weight, drawn.weight),
            eta=torch.where(smooth, delta.eta, torch.where(reflects, 1.0, side.eta_it)).detach(),
        )

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return white; the tints of reflection and transmission are left out."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a rough interface."""
        eta = parameters["eta"]
        return dielectric_split_sum(
            parameters, roughness=mean_roughness(parameters), f0=reflectance_at_normal(eta), eta=eta
        )
