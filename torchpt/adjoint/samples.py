"""What a loss asks of single samples, of what it asks of the picture's pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.integrators.clamp import clamp_scale
from torchpt.settings import Settings

__all__ = ["asked_of", "counted"]


def asked_of(settings: Settings, radiance: Tensor, pixels: Tensor) -> Tensor:
    """Derivatives ``(3, samples, n)`` by the radiance of samples, of those ``(3, n)`` by pixels.

    A pixel is the mean of its samples as they are :func:`counted`.

    Args:
        settings: of the backward pass.
        radiance: of the samples, likewise.
        pixels: of their pixels.
    """
    finite = torch.isfinite(radiance).all(0)
    asked = pixels[:, None] * (finite.to(radiance.dtype) / settings.render.spp)
    clamp = settings.integrator.clamp
    if clamp is None:
        return asked
    values = torch.where(finite, radiance, 0.0)
    # Of v c / m, m the largest channel: what is asked of v, and what it takes back of the channel that is m.
    most, channel = values.abs().max(0, keepdim=True)
    scale = (clamp / most.clamp_min(clamp)).squeeze(0)
    back = (asked * values).sum(0, keepdim=True) * scale / most.clamp_min(clamp)
    back = torch.where(most > clamp, back * values.gather(0, channel).sign(), 0.0)
    return (asked * scale).scatter_add(0, channel, -back)


def counted(settings: Settings, values: Tensor) -> Tensor:
    """Samples ``(3, ...)`` as pixels count them, differentiable: none that is not finite, each scaled to the clamp at most."""
    values = torch.where(torch.isfinite(values.detach()).all(0), values, 0.0)
    clamp = settings.integrator.clamp
    return values if clamp is None else values * clamp_scale(values, clamp)
