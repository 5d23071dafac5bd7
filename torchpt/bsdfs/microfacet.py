"""The microfacet material of the GAMES101 course: ``f = ks D F G / (4 cos_o cos_i) + (1 - F) kd / pi``.

``F`` is the dielectric Fresnel reflectance at the macroscopic normal, of the angle to ``wo``.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torchpt.bsdfs.base import Parameters
from torchpt.bsdfs.glossy import Glossy
from torchpt.math.fresnel import fresnel_dielectric

__all__ = ["Microfacet"]


@dataclass(frozen=True)
class Microfacet(Glossy):
    """Dielectric facets over a diffuse base; not reciprocal, as Fresnel knows of ``wo`` only."""

    name = "microfacet"
    parameters = {  # noqa: RUF012
        "diffuse": (0.5, 0.5, 0.5),
        "specular": (1.0, 1.0, 1.0),
        "roughness": 0.4,
        "ior": 1.85,
    }
    reciprocal = False

    def amounts(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Glossy`."""
        f = fresnel_dielectric(wo[2].clamp_min(0.0), parameters["ior"]).reflectance
        return (1.0 - f) * parameters["diffuse"], f * parameters["specular"]

    def albedo(self, parameters: Parameters) -> Tensor:
        """Both lobes at normal incidence."""
        f0 = (parameters["ior"] - 1.0) / (parameters["ior"] + 1.0)
        f0 = f0 * f0
        return (1.0 - f0) * parameters["diffuse"] + f0 * parameters["specular"]
