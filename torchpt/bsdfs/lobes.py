"""What models of several lobes share: cosines to a power, choice among two, and the weight of a drawn direction."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.bsdfs.base import Bsdf, Parameters
from torchpt.records import BsdfSample

__all__ = ["above", "cosine_power", "drop_of_power", "mean", "reflectance_at_normal", "share", "weighed", "with_delta"]


def above(*directions: Tensor) -> Tensor:
    """1 where all directions ``(3, N)`` are above the surface, else 0: ``(N,)``."""
    least = directions[0][2]
    for w in directions[1:]:
        least = torch.minimum(least, w[2])
    return (least > 0).to(least.dtype)


def cosine_power(drop: Tensor, exponent: Tensor) -> Tensor:
    """``cos^exponent`` of angles ``(N,)`` given as ``drop = 1 - cos``; 0 from a right angle on, also for exponent 0.

    An exponent of 1e5 multiplies the rounding of a cosine near 1 by as much; that of its difference from 1 it leaves small.
    """
    inside = drop < 1.0
    return torch.exp(exponent * torch.log1p(-torch.where(inside, drop, 0.0))) * inside


def drop_of_power(u: Tensor, exponent: Tensor) -> Tensor:
    """``1 - cos`` of angles drawn from ``u (N,)`` with density ``(exponent + 1) / 2 pi cos^exponent`` in solid angle."""
    return -torch.expm1(torch.log1p(-u) / (exponent + 1.0))


def mean(rgb: Tensor) -> Tensor:
    """Of the three channels: ``(3, N) -> (N,)``."""
    return (rgb[0] + rgb[1] + rgb[2]) * (1.0 / 3.0)


def reflectance_at_normal(eta: Tensor) -> Tensor:
    """Of a dielectric of relative index ``eta (N,)``."""
    root = (eta - 1.0) / (eta + 1.0)
    return root * root


def share(a: Tensor, b: Tensor) -> Tensor:
    """Detached ``a / (a + b)``: how often to choose the first of two lobes; always, where both are 0."""
    a, b = a.detach(), b.detach()
    total = a + b
    return torch.where(total > 0, a / torch.where(total > 0, total, 1.0), 1.0)


def weighed(model: Bsdf, parameters: Parameters, wo: Tensor, wi: Tensor, valid: Tensor | None = None) -> BsdfSample:
    """The sample that drew ``wi (3, N)``: weighed by all lobes over the mixture of their densities.

    Direction and density are constants to derivatives: only what is reflected follows the parameters.

    Args:
        model: whose ``eval_pdf`` counts.
        parameters: lane values.
        wo: ``(3, N)``.
        wi: ``(3, N)``.
        valid: ``(N,)`` 0 where the draw failed for reasons that the directions do not tell.
    """
    wi = wi.detach()
    value, pdf = model.eval_pdf(parameters, wo, wi)
    pdf = pdf.detach() if valid is None else pdf.detach() * valid
    drawn = pdf > 0
    return BsdfSample(wi, pdf, torch.where(drawn, value / torch.where(drawn, pdf, 1.0), 0.0))


def with_delta(drawn: BsdfSample, chosen: Tensor, wi: Tensor, weight: Tensor) -> BsdfSample:
    """Lanes that ``chosen (N,)`` marks have drawn a delta lobe instead: ``wi (3, N)`` with ``weight (3, N)``."""
    return replace(
        drawn,
        wi=torch.where(chosen, wi, drawn.wi),
        pdf=torch.where(chosen, torch.inf, drawn.pdf),
        weight=torch.where(chosen, weight, drawn.weight),
    )
