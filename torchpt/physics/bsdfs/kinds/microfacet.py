"""The microfacet material of the GAMES101 course: ``f = ks D F G / (4 cos_o cos_i) + (1 - F) kd / pi``.

``D`` is the GGX distribution of normals, ``G`` the masking, ``ks`` and ``kd`` are the parameters ``specular`` and ``diffuse``.
``F`` is the dielectric Fresnel reflectance for the angle between ``wo`` and the surface normal, not the half vector.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchpt.math.microfacet import fresnel_dielectric
from torchpt.physics.bsdfs.base import Parameters
from torchpt.physics.bsdfs.lobes import Glossy, reflectance_at_normal
from torchpt.physics.bsdfs.records import SplitSumMaterial
from torchpt.physics.bsdfs.specs import GREY, WHITE, fraction, reflectance, refraction_index

__all__ = ["Microfacet"]


@dataclass(frozen=True)
class Microfacet(Glossy):
    """Cook and Torrance's highlight over Lambert, as in the GAMES101 course.

    Not reciprocal, as the Fresnel factor depends on ``wo`` only.
    """

    name = "microfacet"
    parameters: ClassVar = {
        "diffuse": reflectance(GREY, "colour of the diffuse base"),
        "specular": reflectance(WHITE, "factor of light that the facets reflect"),
        "roughness": fraction(0.4, "roughness of the facets: the square root of GGX's alpha"),
        "ior": refraction_index(1.85, "index of refraction of the facets"),
    }
    reciprocal = False

    def lobe_factors(self, parameters: Parameters, wo: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``(1 - F) kd`` and ``F ks``."""
        f = fresnel_dielectric(wo[2].clamp_min(0.0), parameters["ior"]).reflectance
        return (1.0 - f) * parameters["diffuse"], f * parameters["specular"]

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the sum of both lobes at normal incidence."""
        f0 = reflectance_at_normal(parameters["ior"])
        return (1.0 - f0) * parameters["diffuse"] + f0 * parameters["specular"]

    def split_sum(self, parameters: Parameters) -> SplitSumMaterial:
        """Return facets over the diffuse base."""
        specular, f0 = parameters["specular"], reflectance_at_normal(parameters["ior"])
        return SplitSumMaterial(
            diffuse=parameters["diffuse"],
            f0=f0 * specular,
            f90=specular,
            roughness=self.roughness(parameters),
            over=f0,  # the facets lie above the diffuse base, which loses what they reflect
        )
