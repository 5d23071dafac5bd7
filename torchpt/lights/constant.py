"""The constant environment: the same radiance from every direction, sampled uniformly over the sphere."""

from __future__ import annotations

import math

from torch import Tensor

from torchpt.math.warps import uniform_sphere

__all__ = ["INVERSE_PDF", "sample"]

INVERSE_PDF = 4.0 * math.pi


def sample(u: Tensor) -> Tensor:
    """Unit directions ``(3, N)`` toward the environment."""
    return uniform_sphere(u)
