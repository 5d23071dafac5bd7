"""A pane so thin that a ray leaves it where and as it came: both boundaries in one surface."""

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
    choose,
    dielectric_parameters,
    dielectric_split_sum,
    reflectance_at_normal,
    tinted,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import smooth

__all__ = ["ThinDielectric"]


@dataclass(frozen=True)
class ThinDielectric(Glass):
    """A thin polished pane: both its boundaries in one surface, and nothing is bent.

    Reflection, or straight through; both count the series of reflections between its boundaries.
    """

    name = "thindielectric"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), smooth("roughdielectric"))
    lobed = True
    delta = True
    smooth = True
    transmits = True

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        return dielectric_parameters(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing: a delta is not seen."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """The mirror image, or straight on."""
        assert lobe is not None
        sin2 = torch.addcmul(wo[0] * wo[0], wo[1], wo[1])
        r = fresnel_dielectric(wo[2].abs(), parameters["eta"], sin2).reflectance
        reflects, lobe_probability = choose(2.0 * r / (1.0 + r), lobe)  # R + T R T + T R^3 T + ...
        up = torch.where(reflects, wo[2], -wo[2])
        weight = torch.where(
            reflects,
            tinted(lobe_probability, parameters["specular_reflectance"]),
            tinted(lobe_probability, parameters["specular_transmittance"]),
        )
        pdf = torch.where(wo[2] != 0, math.inf, 0.0).to(wo.dtype)
        return BsdfSample(torch.stack((-wo[0], -wo[1], up)), pdf, weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """White: what it takes is what it gives."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """What both boundaries reflect, and the rest straight on."""
        f0 = reflectance_at_normal(parameters["eta"])
        return dielectric_split_sum(parameters, torch.zeros_like(f0), 2.0 * f0 / (1.0 + f0), None)
