"""A diffuse base under a polished clear coat, with all reflections between the two."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.microfacet import diffuse_transmittance, fresnel_dielectric
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.lobes import (
    Coat,
    coat_parameters,
    coated_split_sum,
    lobe_probability,
    mixture_sample,
    tinted,
    with_delta,
)
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.physics.bsdfs.specs import smooth

__all__ = ["Plastic"]


@dataclass(frozen=True)
class Plastic(Coat):
    """A polished coat over a diffuse base.

    Its fit of the coat's mean reflectance (see ``diffuse_transmittance``) conserves energy to 0.02 %.

    Attributes:
        nonlinear: light that the coat throws back takes the base's colour again.
    """

    name = "plastic"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), smooth("roughplastic"))
    lobed = True
    delta = True

    nonlinear: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :class:`Bsdf`."""
        return cls(values["nonlinear"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :class:`Bsdf`."""
        return cls(), cls(nonlinear=True)

    def prepare(self, values: Parameters) -> Parameters:
        """See :class:`Bsdf`."""
        eta = values["int_ior"] / values["ext_ior"]
        return coat_parameters(values, eta, diffuse_transmittance(1.0 / eta), self.nonlinear)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """The base, seen through the coat both ways."""
        f_o = fresnel_dielectric(wo[2], parameters["eta"]).reflectance
        f_i = fresnel_dielectric(wi[2], parameters["eta"]).reflectance
        cosine = wi[2].clamp_min(0.0) * (1.0 / math.pi) * wo[2].sign().clamp_min(0.0)
        value = parameters["base"] * ((1.0 - f_o) * (1.0 - f_i) * cosine)
        return value, (1.0 - self._specular(parameters, f_o)) * cosine

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """The mirror image, or a direction about the normal."""
        assert lobe is not None
        f_o = fresnel_dielectric(wo[2], parameters["eta"]).reflectance
        specular = self._specular(parameters, f_o)
        drawn = mixture_sample(self, parameters, wo, cosine_hemisphere(u))
        chosen = (lobe < specular) & (wo[2] > 0)
        metal_split_sum = torch.stack((-wo[0], -wo[1], wo[2]))
        weight = tinted(f_o / torch.where(specular > 0, specular, 1.0), parameters["specular_reflectance"])
        return with_delta(drawn, chosen, metal_split_sum, weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """That of the base."""
        return parameters["diffuse_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """A mirror over the base."""
        return coated_split_sum(parameters, torch.zeros_like(parameters["eta"]))

    def _specular(self, parameters: Parameters, f_o: Tensor) -> Tensor:
        """How often the coat is chosen."""
        weight = parameters["specular_share"]
        return lobe_probability(f_o * weight, (1.0 - f_o) * (1.0 - weight))
