"""What a loss asks of single samples, of what it asks of the picture's pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.settings import Settings

__all__ = ["asked_of"]


def asked_of(settings: Settings, radiance: Tensor, pixels: Tensor) -> Tensor:
    """Derivatives ``(3, samples, n)`` by the radiance of samples, of those ``(3, n)`` by pixels.

    A pixel is the mean of its samples, without those that are not finite, each scaled to ``integrator.clamp`` at most.

    Args:
        settings: of the backward pass.
        radiance: of the samples, likewise.
        pixels: of their pixels.
    """
    clamp = settings.integrator.clamp
    share = torch.isfinite(radiance).all(0).to(radiance.dtype) / settings.render.spp
    if clamp is not None:
        share = share * (clamp / radiance.abs().amax(0).nan_to_num().clamp_min(clamp)).clamp_max(1.0)
    return pixels[:, None] * share
