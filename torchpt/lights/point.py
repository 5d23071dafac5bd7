"""Points that shine alike in all directions: a position in ``Lights.p0``, an intensity in ``Lights.radiance``."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import dot, safe_reciprocal

__all__ = ["toward"]


def toward(x: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions ``(3, N)`` from ``x (3, N)`` to points, and one over the squared distances ``(N,)``; 0 at the point."""
    to = position - x
    square = dot(to, to)
    return to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt(), safe_reciprocal(square)
