"""A rough boundary between two clear media: GGX microfacets that reflect and refract.

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
from torchpt.physics.bsdfs.lobes import (
    Glass,
    dielectric_parameters,
    dielectric_split_sum,
    mixture_sample,
    polished,
    reflectance_at_normal,
    tinted,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import Anisotropic, alphas, energy_at, energy_table, mean_roughness, rough

__all__ = ["RoughDielectric"]


@dataclass(frozen=True)
class RoughDielectric(Anisotropic, Glass):
    """A boundary between two clear media with GGX microfacets: frosted glass.

    A row with both roughnesses below ``1e-4`` is polished glass, one with equal indices is nothing.

    Attributes:
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
        energy_compensation: what is lost between facets is given back: each direction ``wo`` has both its lobes scaled by
            ``1 / E(wo)``, where E is what leaves at once (Turquin 2019). Masking is correlated by height. Not reciprocal.
    """

    name = "roughdielectric"
    lobed = True
    delta = True
    transmits = True
    refracts = True

    anisotropic: bool = False
    energy_compensation: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(values["alpha_u"] is not None, values["energy_compensation"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`."""
        return tuple(cls(anisotropic, compensated) for compensated in (False, True) for anisotropic in (False, True))

    def tabulate(self, values: Parameters) -> Parameters:
        """The energy that facets give back at once, from either side."""
        if not self.energy_compensation:
            return {}
        surface = self._surface(values)
        # Equal indices would refract nothing: such a row is smooth, and reads no energy.
        eta = torch.where(surface["smooth"], 1.5, surface["eta"])
        return {"energy": energy_table(surface, [eta, 1.0 / eta])}

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        tables = values if "energy" in values else self.tabulate(values)
        return {**self._surface(values), **({"energy": tables["energy"]} if self.energy_compensation else {})}

    def _surface(self, values: Parameters) -> Parameters:
        out = {**dielectric_parameters(values), **rough(values, self.anisotropic)}
        # Facets between equal indices bend nothing, however they lie.
        out["smooth"] = out["smooth"] | ((out["eta"] - 1.0).abs() < INDEX_MATCHED)
        return out

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Equations 20 and 21 of Walter et al., and the densities of equations 14 and 17 for visible normals."""
        au, av = alphas(parameters)
        eta = parameters["eta"]
        reflects = wo[2] * wi[2] > 0
        eta_it = torch.where(wo[2] > 0, eta, 1.0 / eta)
        h = torch.addcmul(wo, wi, torch.where(reflects, 1.0, eta_it))
        m = normalize(h)
        m = m * torch.copysign(torch.ones_like(m[2]), m[2])
        o, i = dot(wo, m), dot(wi, m)
        cos_o, cos_i = wo[2].abs(), wi[2].abs()
        # A facet is seen from the side of the surface on which the direction lies, or not at all.
        seen = torch.minimum(o * wo[2], i * wi[2]) > 0
        on = seen & ~parameters["smooth"]
        side = fresnel_dielectric(o, eta)
        s_o, s_i = microfacet.stretched_length(wo, au, av), microfacet.stretched_length(wi, au, av)
        h2 = dot(h, h)
        # Solid angle of normals over that of wi: 1 / (4 i) and eta^2 i / |wo + eta wi|^2.
        through = (o * i).abs() / torch.where(on, h2, 1.0)
        spread = torch.where(reflects, 0.25, through)
        visible = torch.where(on, microfacet.ggx(m, au, av) * 2.0 / (cos_o + s_o).clamp_min(_TINY) * spread, 0.0)
        r = side.reflectance
        if self.energy_compensation:
            energy = energy_at(parameters["energy"], parameters, wo, (wo[2] < 0).to(wo.dtype))
            value = visible * microfacet.height_correlated_masking(cos_o, s_o, cos_i, s_i) / energy
        else:
            value = visible * microfacet.masking(cos_i, s_i)
        colour = torch.where(
            reflects,
            tinted(r * value, parameters["specular_reflectance"]),
            tinted((1.0 - r) * value, parameters["specular_transmittance"]),
        )
        return colour, visible * torch.where(reflects, r, (1.0 - r) * (eta_it * eta_it))

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """A visible normal, then reflection or refraction as its reflectance has it."""
        assert lobe is not None
        smooth = parameters["smooth"]
        up = torch.copysign(torch.ones_like(wo[2]), wo[2])
        m = microfacet.sample_normal(wo * up, *alphas(parameters), u)
        o = dot(wo, m)
        side = fresnel_dielectric(o, parameters["eta"])
        reflects = lobe < side.reflectance
        wi = torch.where(reflects, microfacet.reflect(wo, m, o), normalize(refract(wo, m, o, side)))
        # A facet may send the ray to the other side of the surface than is meant: no pair of directions is drawn so.
        kept = ((wi[2] * wo[2] > 0) == reflects).to(wo.dtype)
        drawn = mixture_sample(self, parameters, wo, wi, kept)
        clean = polished(parameters, wo, lobe)
        assert clean.eta is not None
        return BsdfSample(
            torch.where(smooth, clean.wi, drawn.wi),
            torch.where(smooth, clean.pdf, drawn.pdf),
            torch.where(smooth, clean.weight, drawn.weight),
            torch.where(smooth, clean.eta, torch.where(reflects, 1.0, side.eta_it)).detach(),
        )

    def albedo(self, parameters: Parameters) -> Tensor:
        """White: what it takes is what it gives."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A rough boundary."""
        eta = parameters["eta"]
        return dielectric_split_sum(parameters, mean_roughness(parameters), reflectance_at_normal(eta), eta)


_TINY = 1e-30
