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
    polished,
    reflectance_at_normal,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import smooth

__all__ = ["Dielectric"]


@dataclass(frozen=True)
class Dielectric(Glass):
    """A polished boundary between two clear media."""

    name = "dielectric"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), smooth("roughdielectric"))
    lobed = True
    delta = True
    smooth = True
    transmits = True
    refracts = True

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        return dielectric_parameters(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing: a delta is not seen."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """The mirror image, or the refracted ray."""
        assert lobe is not None
        return polished(parameters, wo, lobe)

    def albedo(self, parameters: Parameters) -> Tensor:
        """White: what it takes is what it gives."""
        return torch.ones_like(parameters["eta"]).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A smooth boundary."""
        eta = parameters["eta"]
        return dielectric_split_sum(parameters, torch.zeros_like(eta), reflectance_at_normal(eta), eta)
