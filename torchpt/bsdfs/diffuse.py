"""Lambert's diffuse reflection: ``f = reflectance / pi``. Two-sided unless ``two_sided`` says otherwise."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.bsdfs.base import Parameters
from torchpt.math.warps import cosine_hemisphere
from torchpt.records import BsdfSample

__all__ = ["PARAMETERS", "albedo", "eval", "pdf", "sample"]

PARAMETERS = ("reflectance", "two_sided")


def _cosine(parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
    """``|cos(theta_i)|`` where both directions lie on a side that reflects, else 0."""
    two_sided = parameters["two_sided"]
    # On the same side the product with the sign of wo.z is |wi.z|; on opposite sides it is negative.
    side = torch.sign(wo[2]) if two_sided is None else torch.where(two_sided | (wo[2] > 0), torch.sign(wo[2]), 0.0)
    return (wi[2] * side).clamp_min(0.0)


def eval(parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
    """``f |cos(theta_i)|``: ``(3, N), (3, N) -> (3, N)``."""
    reflectance = parameters["reflectance"]
    assert reflectance is not None
    return reflectance * (_cosine(parameters, wo, wi) * (1.0 / math.pi))


def pdf(parameters: Parameters, wo: Tensor, wi: Tensor) -> Tensor:
    """``|cos(theta_i)| / pi``: ``(N,)``."""
    return _cosine(parameters, wo, wi) * (1.0 / math.pi)


def sample(parameters: Parameters, wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
    """Cosine-weighted direction on the side of ``wo``."""
    wi = cosine_hemisphere(u, wo[2])
    density = pdf(parameters, wo, wi)
    reflectance = parameters["reflectance"]
    assert reflectance is not None
    return BsdfSample(wi, density, reflectance)


def albedo(parameters: Parameters) -> Tensor:
    """Colour for the albedo layer ``(3, N)``."""
    reflectance = parameters["reflectance"]
    assert reflectance is not None
    return reflectance
