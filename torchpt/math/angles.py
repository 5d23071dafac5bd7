"""An angle that rounds alike at every lane position, which ``torch.atan2`` does not."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["SERIES", "azimuth"]

#: ``atan(x) / x`` in powers of ``x^2`` for ``|x| <= tan(pi / 8)``: Chebyshev interpolation, error below 3e-13.
SERIES = (
    0.9999999999992449,
    -0.33333333276920757,
    0.19999993053407192,
    -0.1428538654655432,
    0.11103456759179119,
    -0.08992551401945466,
    0.06974190432707487,
    -0.03765497158862104,
)
_TURN = 2.0 * math.pi


def azimuth(x: Tensor, y: Tensor) -> Tensor:
    """Angles ``(N,)`` in ``[0, 2 pi)`` from +x to ``(x, y)``, counter-clockwise; 0, with finite derivatives, at the origin."""
    # Signs as factors, and never 0: |x| would lose the derivative on an axis.
    sign_x, sign_y = (torch.copysign(torch.ones_like(a), a).detach() for a in (x, y))
    a, b = x * sign_x, y * sign_y
    steep = b > a
    low, high = torch.where(steep, a, b), torch.where(steep, b, a)
    # Scaled by a constant, so that the sum below neither overflows nor vanishes.
    scale = high.detach()
    scale = torch.where(scale > 0, scale, 1.0)
    low, high = low / scale, torch.where(high > 0, high / scale, 1.0)
    # atan(r) = pi / 4 + atan((r - 1) / (r + 1)) brings the upper half of the octant to the lower one.
    upper = low > (math.sqrt(2.0) - 1.0) * high
    ratio = torch.where(upper, low - high, low) / torch.where(upper, low + high, high)
    square = ratio * ratio
    series = torch.full_like(square, SERIES[-1])
    for coefficient in reversed(SERIES[:-1]):
        series = series * square + coefficient
    angle = ratio * series + upper.to(x.dtype) * (0.25 * math.pi)
    angle = torch.where(steep, 0.5 * math.pi - angle, angle)
    angle = torch.where(x < 0, math.pi - angle, angle)
    angle = torch.where(y < 0, _TURN - angle, angle)
    return torch.where(angle >= _TURN, angle - _TURN, angle)
