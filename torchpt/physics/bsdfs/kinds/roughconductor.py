"""A rough conductor: microfacets with single scattering, or with compensation of the energy of multiple scattering."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.kept_tables import keep_tables
from torchpt.physics.bsdfs.lobes import mixture_sample, with_delta
from torchpt.physics.bsdfs.metal import Metal, by_reflectance, metal_colour, metal_parameters, metal_split_sum
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import (
    Anisotropic,
    alphas,
    energy_at,
    energy_table,
    mean_roughness,
    roughness_parameters,
)

__all__ = ["RoughConductor"]


@dataclass(frozen=True)
class RoughConductor(Anisotropic, Metal):
    """A metal with microfacets.

    A row with both alphas below ``1e-4`` is smooth: a delta lobe.

    Light that meets more than one facet is lost, unless it is compensated (Turquin, *Practical Multiple Scattering
    Compensation for Microfacet Models*, 2019, equation 16): the lobe of ``wo`` is scaled by ``1 + F0 (1 - E) / E``, where
    ``E(wo)`` is the directional albedo of facets with reflectance 1.

    Attributes:
        schlick: the colour is ``reflectance`` at normal incidence, not ``eta`` and ``k``.
        beckmann: the distribution is Beckmann's, not GGX.
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
        energy_compensation: scale the lobe by that factor, with height-correlated masking. Not reciprocal.
    """

    name = "roughconductor"
    delta = True

    schlick: bool = False
    beckmann: bool = False
    anisotropic: bool = False
    energy_compensation: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        return (
            cls(
                schlick=by_reflectance(values),
                beckmann=values["distribution"] == "beckmann",
                anisotropic=values["alpha_u"] is not None,
                energy_compensation=values["energy_compensation"],
            ),
            cls.given(values),
        )

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """Return all pairs of ``schlick`` and ``anisotropic``, two with energy compensation, and three of Beckmann's facets."""
        plain = [
            cls(schlick=schlick, anisotropic=anisotropic) for anisotropic in (False, True) for schlick in (False, True)
        ]
        compensated = (cls(energy_compensation=True), cls(anisotropic=True, energy_compensation=True))
        beckmann = (
            cls(beckmann=True),
            cls(beckmann=True, anisotropic=True),
            cls(beckmann=True, energy_compensation=True),
        )
        return *plain, *compensated, *beckmann

    @keep_tables
    def tabulate(self, values: Parameters) -> Parameters:
        """Return the table of directional albedo for energy compensation."""
        if not self.energy_compensation:
            return {}
        surface = roughness_parameters(values, anisotropic=self.anisotropic)
        return {"energy": energy_table(surface, etas=[None], facets=self.facets)}

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters of one material, or of all lanes, from its values; see :meth:`Bsdf.prepare`."""
        tables = values if "energy" in values else self.tabulate(values)
        energy = {"energy": tables["energy"]} if self.energy_compensation else {}
        return {**metal_parameters(values), **roughness_parameters(values, anisotropic=self.anisotropic), **energy}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        facets = self.facets.reflection(
            wo, wi, *alphas(parameters), bounded=microfacet.BOUNDED, by_height=self.energy_compensation
        )
        # 1, or 0 where the surface is a mirror: `eval` leaves deltas out.
        is_rough = (~parameters["smooth"]).to(wo.dtype)
        value = self._colour(parameters, facets.cos_m) * (facets.value * is_rough)
        if self.energy_compensation:
            f0 = metal_colour(parameters, cos=torch.ones_like(wo[2]))
            value = torch.addcmul(value, value * f0, 1.0 / energy_at(parameters["energy"], parameters, wo) - 1.0)
        return value, facets.pdf * is_rough

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at a visible normal, or at the surface normal where the surface is smooth."""
        m = self.facets.sample_normal(wo, *alphas(parameters), u, bounded=microfacet.BOUNDED)
        drawn = mixture_sample(self, parameters, wo, microfacet.reflect(wo, m, dot(wo, m)))
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        return with_delta(drawn, parameters["smooth"] & (wo[2] > 0), mirror, self._colour(parameters, wo[2]))

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the reflectance at normal incidence."""
        return self._colour(parameters, torch.ones_like(parameters["alpha_u"]))

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a rough mirror."""
        return metal_split_sum(parameters, mean_roughness(parameters))

    def _colour(self, parameters: Parameters, cos: Tensor) -> Tensor:
        """Return the reflectance ``(3, N)`` at a cosine ``(N,)``, with the factor ``specular_reflectance``."""
        colour = metal_colour(parameters, cos)
        return colour if parameters["specular_reflectance"] is None else colour * parameters["specular_reflectance"]
