"""A thin dielectric pane: both interfaces in one surface, so that transmitted rays are neither moved nor bent."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.microfacet import fresnel_dielectric
from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.lobes import (
    Glass,
    choose_reflection,
    dielectric_parameters,
    dielectric_split_sum,
    reflectance_at_normal,
    tinted,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import no_roughness

__all__ = ["ThinDielectric"]


@dataclass(frozen=True)
class ThinDielectric(Glass):
    """A thin smooth pane: two interfaces in one surface, through which light passes straight on.

    Reflectance and transmittance include all reflections between the two interfaces.
    """

    name = "thindielectric"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), no_roughness("roughdielectric"))
    lobed = True  # `sample` reads a number `lobe`, which chooses between reflection and transmission
    delta = True
    smooth = True
    transmits = True

    def prepare(self, values: Parameters) -> Parameters:
        """Return the relative index and the two factors."""
        return dielectric_parameters(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros: deltas are left out."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect, or continue straight on."""
        assert lobe is not None
        sin2 = torch.addcmul(wo[0] * wo[0], wo[1], wo[1])
        r = fresnel_dielectric(wo[2].abs(), parameters["eta"], sin2).reflectance  # of one interface
        # Of both, with T = 1 - R: R + T R T + T R^3 T + ... = 2 R / (1 + R).
        reflects, weight_of_choice = choose_reflection(2.0 * r / (1.0 + r), lobe)
        z = torch.where(reflects, wo[2], -wo[2])
        weight = torch.where(
            reflects,
            tinted(weight_of_choice, parameters["specular_reflectance"]),
            tinted(weight_of_choice, parameters["specular_transmittance"]),
        )
        pdf = torch.where(wo[2] != 0, math.inf, 0.0).to(wo.dtype)
        return BsdfSample(wi=torch.stack((-wo[0], -wo[1], z)), pdf=pdf, weight=weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return white; the tints of reflection and transmission are left out."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return the reflectance of both interfaces; the rest passes straight on."""
        f0 = reflectance_at_normal(parameters["eta"])
        return dielectric_split_sum(parameters, roughness=torch.zeros_like(f0), f0=2.0 * f0 / (1.0 + f0), eta=None)
