"""A rough metal: GGX microfacets of a conductor, reflected once, or with the energy of further reflections given back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math import microfacet
from torchpt.math.vectors import dot
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import mixture_sample, with_delta
from torchpt.physics.bsdfs.metal import Metal, by_reflectance, metal, metal_colour, metal_split_sum
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.rough import Anisotropic, alphas, energy_at, energy_table, mean_roughness, rough

__all__ = ["RoughConductor"]


@dataclass(frozen=True)
class RoughConductor(Anisotropic, Metal):
    """A metal with GGX microfacets.

    A row with both roughnesses below ``1e-4`` is a smooth one: a delta lobe.

    Facets shade one another; light that meets more than one of them is lost, unless it is given back as Turquin does
    (*Practical Multiple Scattering Compensation for Microfacet Models*, 2019, equation 16): each direction ``wo`` has its
    lobe scaled by ``1 + F0 (1 - E) / E``, with ``E(wo)`` what facets of reflectance 1 give back.

    Attributes:
        schlick: its colour is given as ``reflectance`` at normal incidence rather than as ``eta`` and ``k``.
        anisotropic: ``alpha_u`` and ``alpha_v`` may differ.
        energy_compensation: scaled so, and with masking correlated by height; not reciprocal then.
    """

    name = "roughconductor"
    delta = True

    schlick: bool = False
    anisotropic: bool = False
    energy_compensation: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return (
            cls(by_reflectance(values), values["alpha_u"] is not None, values["energy_compensation"]),
            cls.given(values),
        )

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`; either colour with lost energy given back."""
        plain = [cls(schlick, anisotropic) for anisotropic in (False, True) for schlick in (False, True)]
        return *plain, cls(energy_compensation=True), cls(anisotropic=True, energy_compensation=True)

    def tabulate(self, values: Parameters) -> Parameters:
        """The energy that facets give back at once."""
        return {"energy": energy_table(rough(values, self.anisotropic), [None])} if self.energy_compensation else {}

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        tables = values if "energy" in values else self.tabulate(values)
        energy = {"energy": tables["energy"]} if self.energy_compensation else {}
        return {**metal(values), **rough(values, self.anisotropic), **energy}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Bsdf`."""
        at = microfacet.reflection(wo, wi, *alphas(parameters), microfacet.BOUNDED, self.energy_compensation)
        on = (~parameters["smooth"]).to(wo.dtype)
        value = self._colour(parameters, at.cos_m) * (at.value * on)
        if self.energy_compensation:
            f0 = metal_colour(parameters, torch.ones_like(wo[2]))
            value = torch.addcmul(value, value * f0, 1.0 / energy_at(parameters["energy"], parameters, wo) - 1.0)
        return value, at.pdf * on

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at a visible normal; at the surface's own where it is smooth."""
        m = microfacet.sample_normal(wo, *alphas(parameters), u, microfacet.BOUNDED)
        drawn = mixture_sample(self, parameters, wo, microfacet.reflect(wo, m, dot(wo, m)))
        metal_split_sum = torch.stack((-wo[0], -wo[1], wo[2]))
        return with_delta(drawn, parameters["smooth"] & (wo[2] > 0), metal_split_sum, self._colour(parameters, wo[2]))

    def albedo(self, parameters: Parameters) -> Tensor:
        """The colour at normal incidence."""
        return self._colour(parameters, torch.ones_like(parameters["alpha_u"]))

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A rough mirror."""
        return metal_split_sum(parameters, mean_roughness(parameters))

    def _colour(self, parameters: Parameters, cos: Tensor) -> Tensor:
        colour = metal_colour(parameters, cos)
        return colour if parameters["specular_reflectance"] is None else colour * parameters["specular_reflectance"]
