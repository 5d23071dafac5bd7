"""Multiple importance sampling (Veach, *Robust Monte Carlo Methods for Light Transport Simulation*, 1997, section 9.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import safe_reciprocal

__all__ = ["power_heuristic"]


def power_heuristic(a: Tensor, b: Tensor) -> Tensor:
    """Weight ``a^2 / (a^2 + b^2)`` of the strategy with density ``a``, both ``(N,)``; 0 where ``a`` is 0, 1 where it is inf.

    Written as ``1 / (1 + (b/a)^2)``: the densities' own squares would leave float32's range above 1.8e19. The ratio may
    overflow to infinity, which gives the right limit 0.
    """
    ratio = b * safe_reciprocal(a)
    return torch.sign(a) / (1.0 + ratio * ratio)
