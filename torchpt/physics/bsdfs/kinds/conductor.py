"""A smooth conductor: a mirror with Fresnel's reflectance of a complex index, or with Schlick's approximation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.metal import Metal, by_reflectance, metal_colour, metal_parameters, metal_split_sum
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import no_roughness

__all__ = ["Conductor"]


@dataclass(frozen=True)
class Conductor(Metal):
    """A polished metal; without a metal, a perfect mirror.

    Attributes:
        schlick: the colour is ``reflectance`` at normal incidence, not ``eta`` and ``k``.
    """

    name = "conductor"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness", "alpha_u", "alpha_v"), no_roughness("roughconductor"))
    delta = True
    smooth = True

    schlick: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        return cls(schlick=by_reflectance(values)), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        return cls(), cls(schlick=True)

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters of one material, or of all lanes, from its values; see :meth:`Bsdf.prepare`."""
        return metal_parameters(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros: deltas are left out."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect ``wo`` at the surface."""
        wi = torch.stack((-wo[0], -wo[1], wo[2]))
        colour = metal_colour(parameters, wo[2].clamp_min(0.0))
        if parameters["specular_reflectance"] is not None:
            colour = colour * parameters["specular_reflectance"]
        return BsdfSample(wi=wi, pdf=torch.where(wo[2] > 0, math.inf, 0.0).to(wo.dtype), weight=colour)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the reflectance at normal incidence."""
        present = parameters["eta"] if parameters["reflectance"] is None else parameters["reflectance"]
        colour = metal_colour(parameters, cos=torch.ones_like(present[0]))
        return colour if parameters["specular_reflectance"] is None else colour * parameters["specular_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a mirror."""
        present = parameters["eta"] if parameters["reflectance"] is None else parameters["reflectance"]
        return metal_split_sum(parameters, roughness=torch.zeros_like(present[0]))
