"""Paint, wood, cloth: ``f = s f_GGX + (1 - s) base / pi``, where ``s`` is a constant reflectance such as 0.04."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchpt.bsdfs.base import Parameters
from torchpt.bsdfs.glossy import Glossy

__all__ = ["Nonmetal"]


@dataclass(frozen=True)
class Nonmetal(Glossy):
    """Facets of one reflectance at every angle over a diffuse base."""

    name = "nonmetal"
    parameters = {"base_color": (0.5, 0.5, 0.5), "specular": 0.04, "roughness": 0.5}  # noqa: RUF012

    def amounts(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Glossy`."""
        s = parameters["specular"]
        return (1.0 - s) * parameters["base_color"], s.expand_as(parameters["base_color"])

    def albedo(self, parameters: Parameters) -> Tensor:
        """Both lobes."""
        diffuse, specular = self.amounts(parameters, parameters["base_color"])
        return diffuse + specular
