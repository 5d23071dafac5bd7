"""Angles of vectors, by sums, products and roots: torch's ``atan2`` rounds differently by a lane's place in memory."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["azimuth"]


def azimuth(x: Tensor, y: Tensor) -> Tensor:
    """The angle of ``(x, y)`` from the x axis, ``(N,)`` in [0, 2 pi]; 0 at the origin, with a zero gradient there.

    The angle within an octant is halved twice by ``tan(a / 2) = t / (1 + sqrt(1 + t^2))``, then summed by its series,
    whose first term left out is below 1e-14.
    """
    long, short = torch.maximum(x.abs(), y.abs()), torch.minimum(x.abs(), y.abs())
    some = long > 0
    t = short / torch.where(some, long, 1.0)
    for _ in range(2):
        t = t / (1.0 + torch.addcmul(torch.ones_like(t), t, t).sqrt())
    square = t * t
    series = torch.full_like(t, 1.0 / 17.0)
    for k in range(15, 0, -2):
        series = 1.0 / k - series * square
    angle = 4.0 * t * series
    angle = torch.where(y.abs() > x.abs(), 0.5 * math.pi - angle, angle)
    angle = torch.where(x < 0, math.pi - angle, angle)
    return torch.where(y < 0, 2.0 * math.pi - angle, angle)
