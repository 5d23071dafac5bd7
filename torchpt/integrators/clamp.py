"""The bound on what a single path may bring: ``integrator.clamp``."""

from __future__ import annotations

from torch import Tensor

__all__ = ["clamp_scale"]


def clamp_scale(values: Tensor, clamp: float) -> Tensor:
    """What samples ``(3, ...)`` are scaled with ``(...)``, so that no channel is beyond ``clamp``; hue stays as it is."""
    return clamp / values.abs().amax(0).clamp_min(clamp)
