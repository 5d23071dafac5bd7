"""What plastics share: a diffuse base under a clear coat."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.bsdfs.glass import tinted
from torchpt.bsdfs.lobes import mean, reflectance_at_normal, share
from torchpt.bsdfs.presets import INDICES
from torchpt.bsdfs.specs import GREY, index, reflectance
from torchpt.math.fresnel import diffuse_passed
from torchpt.records import SplitSumMaterial
from torchpt.spec import Flag

__all__ = ["Coat", "coated", "over_base"]


class Coat(Bsdf, part=True):
    """A part of a model: the base's colour, the coat's media and tint."""

    parameters: ClassVar = {
        "diffuse_reflectance": reflectance(GREY, "colour of the base"),
        "int_ior": index(INDICES["polypropylene"], "index of refraction of the coat"),
        "ext_ior": index(INDICES["air"], "index of refraction in front of it"),
        "specular_reflectance": reflectance(None, "a tint: a factor of what the coat reflects; 1 where it is not said"),
        "nonlinear": Flag(False, doc="whether light that the coat throws back takes the base's colour again"),
    }


def coated(values: Parameters, eta: Tensor, passed: Tensor, nonlinear: bool) -> Parameters:
    """What the coats have in common.

    Args:
        values: as given.
        eta: ``(1,)`` index of the coat over that outside.
        passed: ``(1,)`` part of diffuse light from within that the coat lets out.
        nonlinear: whether light that the coat throws back takes the base's colour again, which saturates it.
    """
    diffuse, specular = values["diffuse_reflectance"], values.get("specular_reflectance")
    often, again = mean(diffuse), diffuse if nonlinear else 1.0
    return {
        "eta": eta,
        "base": diffuse / ((1.0 - again + again * passed) * eta * eta),
        "diffuse_reflectance": diffuse,
        "specular_reflectance": specular,
        "specular_share": share(torch.ones_like(often) if specular is None else mean(specular), often),
    }


def over_base(parameters: Parameters, roughness: Tensor) -> SplitSumMaterial:
    """A coat in the preview, over a base which light enters by what the coat's mean reflectance leaves."""
    eta, factor = parameters["eta"], parameters["specular_reflectance"]
    one = torch.ones_like(eta)
    base = parameters["base"] * diffuse_passed(eta)
    f0 = reflectance_at_normal(eta)
    return SplitSumMaterial(base, tinted(f0, factor), tinted(one, factor), roughness, f0)
