"""A polished boundary between two clear media."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.lobes import (
    Glass,
    dielectric_parameters,
    dielectric_split_sum,
    reflectance_at_normal,
    sample_smooth_interface,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import no_roughness

__all__ = ["Dielectric"]


@dataclass(frozen=True)
class Dielectric(Glass):
    """A polished boundary between two clear media."""

    name = "dielectric"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), no_roughness("roughdielectric"))
    lobed = True  # `sample` reads a number `lobe`, which chooses between reflection and refraction
    delta = True
    smooth = True
    transmits = True
    refracts = True

    def prepare(self, values: Parameters) -> Parameters:
        """Return the relative index and the two factors."""
        return dielectric_parameters(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros: deltas are left out."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect or refract, by the Fresnel reflectance."""
        assert lobe is not None
        return sample_smooth_interface(parameters, wo, lobe)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return white; the tints of reflection and transmission are left out."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a smooth interface."""
        eta = parameters["eta"]
        return dielectric_split_sum(parameters, roughness=torch.zeros_like(eta), f0=reflectance_at_normal(eta), eta=eta)
