"""What models of Lambert and a lobe of a cosine's power share: their parameters, and how much energy they may make."""

from __future__ import annotations

from typing import ClassVar

from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters, Values
from torchpt.bsdfs.specs import GREY, reflectance
from torchpt.records import SplitSumMaterial
from torchpt.spec import Scalar

__all__ = ["Power", "added"]


class Power(Bsdf, part=True):
    """A part of a model: a diffuse and a glossy reflectance, and how sharp the lobe is.

    Attributes:
        most: energy that a unit of ``specular`` reflects at most.
    """

    parameters: ClassVar = {
        "diffuse": reflectance(GREY, "reflectance of the diffuse lobe"),
        "specular": reflectance((0.2, 0.2, 0.2), "reflectance of the glossy one"),
        "exponent": Scalar(30.0, high=1e5, texture=True, doc="how sharp the glossy one is: the power of its cosine"),
    }
    lobed = True
    most: ClassVar[float] = 1.0

    @classmethod
    def energy(cls, values: Values) -> str:
        """See :class:`Bsdf`."""
        diffuse, specular = values["diffuse"], values["specular"]
        if not isinstance(diffuse, tuple) or not isinstance(specular, tuple):
            return ""
        most = max(kd + cls.most * ks for kd, ks in zip(diffuse, specular, strict=True))
        if most <= 1.0 + 1e-6:
            return ""
        terms = "diffuse + specular" if cls.most == 1.0 else f"diffuse + {cls.most:g} specular"
        return f"{terms} is {most:.4g}: above 1 it may reflect more light than it receives"


def added(parameters: Parameters, alpha2: Tensor, peak: Tensor | float) -> SplitSumMaterial:
    """Both lobes in the preview, added.

    Args:
        parameters: lane values.
        alpha2: square of the roughness of facets that would reflect as the lobe does ``(N,)``.
        peak: what the lobe reflects of ``specular`` at normal incidence.
    """
    specular = parameters["specular"] * peak
    roughness = alpha2.clamp(0.0, 1.0).sqrt().sqrt()
    return SplitSumMaterial(parameters["diffuse"], specular, specular, roughness, None)
