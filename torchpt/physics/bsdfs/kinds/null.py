"""The null BSDF: light passes as if there were no surface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.physics.bsdfs.base import Bsdf, Parameters, Values
from torchpt.physics.bsdfs.records import BsdfSample, SplitSumMaterial
from torchpt.spec import Refused

__all__ = ["Null"]


@dataclass(frozen=True)
class Null(Bsdf):
    """Nothing: light passes as if the surface were not there."""

    name = "null"
    sheer = True  # rays pass without counting a bounce
    delta = True
    smooth = True
    transmits = True

    @classmethod
    def check(cls, values: Values, given: frozenset[str]) -> None:
        """Refuse opacity and emission."""
        super().check(values, given)
        for key in ("opacity", "alpha_cutoff", "emission"):
            if key in given:
                why = "a null surface has nothing to cover or to emit (use another type with opacity)"
                raise Refused(f"no {key}, as {why}", values[key], (key,))

    def prepare(self, values: Parameters) -> Parameters:
        """Return one flag ``(1,)``, from which other methods take the number of lanes, as there are no parameters."""
        return {"row": torch.ones(1, dtype=torch.bool)}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Return zeros: deltas are left out."""
        return torch.zeros_like(wi), torch.zeros_like(wi[2])

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Continue straight on."""
        return BsdfSample(wi=-wo, pdf=torch.full_like(wo[2], math.inf), weight=torch.ones_like(wo))

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return white, as all light passes."""
        return torch.ones_like(parameters["row"], dtype=torch.float32).expand(3, -1)

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return a material that transmits all light."""
        black = torch.zeros(3, len(parameters["row"]), dtype=torch.float32, device=parameters["row"].device)
        zero = black[0]
        return SplitSumMaterial(diffuse=black, f0=zero, f90=zero, roughness=zero, over=zero, through=black + 1.0)
