"""Paint, wood, cloth: ``f = s f_GGX + (1 - s) base / pi``, where ``s`` is a constant reflectance such as 0.04."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.lobes import Glossy
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.bsdfs.specs import GREY, fraction, reflectance

__all__ = ["Nonmetal"]


@dataclass(frozen=True)
class Nonmetal(Glossy):
    """A fixed share of a GGX highlight over Lambert."""

    name = "nonmetal"
    parameters: ClassVar = {
        "base_color": reflectance(GREY, "colour of the diffuse base"),
        "specular": fraction(0.04, "reflectance of the highlight"),
        "roughness": fraction(0.5, "roughness of the facets: the square root of GGX's alpha"),
    }

    def lobe_factors(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``1 - s`` times the base colour, and ``s``."""
        s = parameters["specular"]
        return (1.0 - s) * parameters["base_color"], s.expand_as(parameters["base_color"])

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the sum of both lobes."""
        # The factors depend on no direction: any tensor will do as wo.
        diffuse, specular = self.lobe_factors(parameters, wo=parameters["base_color"])
        return diffuse + specular

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return facets with the same reflectance at every angle, over the diffuse base."""
        s = parameters["specular"]
        roughness = self.roughness(parameters)
        return SplitSumMaterial(
            diffuse=parameters["base_color"],
            f0=s,
            f90=s,
            roughness=roughness,
            over=s,  # the facets lie above the diffuse base, which loses what they reflect
        )
