"""A smooth metal: a mirror whose colour is Fresnel's for a complex index, or Schlick's for one at normal incidence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.metal import Metal, by_reflectance, metal, metal_colour, metal_split_sum
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import smooth

__all__ = ["Conductor"]


@dataclass(frozen=True)
class Conductor(Metal):
    """A polished metal; without a metal, a perfect mirror.

    Attributes:
        schlick: its colour is given as ``reflectance`` at normal incidence rather than as ``eta`` and ``k``.
    """

    name = "conductor"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness", "alpha_u", "alpha_v"), smooth("roughconductor"))
    delta = True
    smooth = True

    schlick: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(by_reflectance(values)), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`."""
        return cls(), cls(schlick=True)

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        return metal(values)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing: a delta is not seen."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """The mirror image."""
        wi = torch.stack((-wo[0], -wo[1], wo[2]))
        colour = metal_colour(parameters, wo[2].clamp_min(0.0))
        if parameters["specular_reflectance"] is not None:
            colour = colour * parameters["specular_reflectance"]
        return BsdfSample(wi, torch.where(wo[2] > 0, math.inf, 0.0).to(wo.dtype), colour)

    def albedo(self, parameters: Parameters) -> Tensor:
        """The colour at normal incidence."""
        some = parameters["eta"] if parameters["reflectance"] is None else parameters["reflectance"]
        colour = metal_colour(parameters, torch.ones_like(some[0]))
        return colour if parameters["specular_reflectance"] is None else colour * parameters["specular_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A mirror."""
        like = next(parameters[key] for key in ("reflectance", "eta") if parameters[key] is not None)
        return metal_split_sum(parameters, torch.zeros_like(like[0]))
