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
from torchpt.physics.bsdfs.specs import no_roughness

__all__ = ["Plastic"]


@dataclass(frozen=True)
class Plastic(Coat):
    """A polished coat over a diffuse base.

    The fit of the coat's mean transmittance (``diffuse_transmittance``) conserves energy to 0.02 %.

    Attributes:
        nonlinear: internally reflected light is multiplied by the base's colour again.
    """

    name = "plastic"
    parameters: ClassVar = dict.fromkeys(("alpha", "roughness"), no_roughness("roughplastic"))
    lobed = True  # `sample` reads a number `lobe`, which chooses between coat and base
    delta = True

    nonlinear: bool = False

    @classmethod
    def of(cls, values: Values) -> tuple[Bsdf, dict[str, Any]]:
        """See :meth:`Bsdf.of`."""
        return cls(nonlinear=values["nonlinear"]), cls.given(values)

    @classmethod
    def variants(cls) -> tuple[Bsdf, ...]:
        """See :meth:`Bsdf.variants`."""
        return cls(), cls(nonlinear=True)

    def prepare(self, values: Parameters) -> Parameters:
        """Return the parameters of one material, or of all lanes, from its values; see :meth:`Bsdf.prepare`."""
        eta = values["int_ior"] / values["ext_ior"]
        # The inverse: light of the base meets the coat from within.
        return coat_parameters(values, eta, diffuse_transmittance(1.0 / eta), nonlinear=self.nonlinear)

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return the base, attenuated by the coat on the way in and out; the coat itself is a delta."""
        f_o = fresnel_dielectric(wo[2], parameters["eta"]).reflectance  # of the coat, for wo and wi
        f_i = fresnel_dielectric(wi[2], parameters["eta"]).reflectance
        # Over pi; 0 where wo is not above the surface.
        cosine = wi[2].clamp_min(0.0) * (1.0 / math.pi) * wo[2].sign().clamp_min(0.0)
        value = parameters["base"] * ((1.0 - f_o) * (1.0 - f_i) * cosine)
        return value, (1.0 - self._coat_probability(parameters, f_o)) * cosine

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Reflect at the coat, or sample the base by the cosine."""
        assert lobe is not None
        f_o = fresnel_dielectric(wo[2], parameters["eta"]).reflectance
        coat_probability = self._coat_probability(parameters, f_o)
        drawn = mixture_sample(self, parameters, wo, cosine_hemisphere(u))
        chosen = (lobe < coat_probability) & (wo[2] > 0)
        mirror = torch.stack((-wo[0], -wo[1], wo[2]))
        weight = tinted(
            f_o / torch.where(coat_probability > 0, coat_probability, 1.0), parameters["specular_reflectance"]
        )
        return with_delta(drawn, chosen, mirror, weight)

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the albedo of the base."""
        return parameters["diffuse_reflectance"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a mirror over the base."""
        return coated_split_sum(parameters, torch.zeros_like(parameters["eta"]))

    def _coat_probability(self, parameters: Parameters, f_o: Tensor) -> Tensor:
        """Return the probability of choosing the coat ``(N,)``, for its reflectance ``f_o (N,)`` at ``wo``."""
        weight = parameters["coat_weight"]
        return lobe_probability(f_o * weight, (1.0 - f_o) * (1.0 - weight))
