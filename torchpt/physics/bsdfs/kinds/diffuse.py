"""Lambert's diffuse reflection: ``f = reflectance / pi``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs.base import Bsdf, Parameters
from torchpt.physics.bsdfs.records import BsdfSample
from torchpt.physics.bsdfs.specs import GREY, reflectance

__all__ = ["Diffuse"]


@dataclass(frozen=True)
class Diffuse(Bsdf):
    """Lambert: the same radiance into all directions."""

    name = "diffuse"
    parameters: ClassVar = {"reflectance": reflectance(GREY, "share of the light that is reflected")}

    def eval_pdf(self, parameters: Parameters, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Bsdf.eval_pdf`."""
        density = wi[2].clamp_min(0.0) * (1.0 / math.pi)  # callers see to wo.z >= 0, as the model transmits nothing
        return parameters["reflectance"] * density, density

    def sample(self, parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """Sample the cosine-weighted hemisphere."""
        wi = cosine_hemisphere(u)
        return BsdfSample(wi=wi, pdf=wi[2] * (1.0 / math.pi), weight=parameters["reflectance"])

    def albedo(self, parameters: Parameters) -> Tensor:
        """Return the reflectance."""
        return parameters["reflectance"]
