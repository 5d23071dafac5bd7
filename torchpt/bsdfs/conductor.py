"""A smooth metal: a mirror whose colour is Fresnel's for a complex index, or Schlick's for one at normal incidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.math.fresnel import fresnel_conductor, schlick
from torchpt.records import BsdfSample

__all__ = ["Conductor", "metal", "metal_colour"]


def metal(values: Parameters) -> Parameters:
    """What :func:`metal_colour` reads: ``eta`` and ``k``, or ``reflectance``; the others are None."""
    names = ("reflectance",) if "reflectance" in values else ("eta", "k")
    absent = dict.fromkeys(("eta", "k", "reflectance", "specular_reflectance"))
    return {
        **absent,
        **{name: values[name] for name in names},
        "specular_reflectance": values.get("specular_reflectance"),
    }


def metal_colour(parameters: Parameters, cos: Tensor) -> Tensor:
    """Reflectance ``(3, N)`` at a cosine ``(N,)``, without the factor ``specular_reflectance``."""
    if parameters["reflectance"] is not None:
        return schlick(cos, parameters["reflectance"])
    return fresnel_conductor(cos, parameters["eta"], parameters["k"])


@dataclass(frozen=True)
class Conductor(Bsdf):
    """A mirror.

    Attributes:
        schlick: its colour is given as ``reflectance`` at normal incidence rather than as ``eta`` and ``k``.
    """

    name = "conductor"
    parameters = {  # noqa: RUF012
        "eta": (0.0, 0.0, 0.0),
        "k": (1.0, 1.0, 1.0),
        "reflectance": (1.0, 1.0, 1.0),
        "specular_reflectance": (1.0, 1.0, 1.0),
    }
    delta = True
    smooth = True

    schlick: bool = False

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
