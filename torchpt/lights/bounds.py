"""Where lights lie and where they shine: what the light tree asks of the table's rows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import luminance
from torchpt.records import DISTANT, Lights

__all__ = ["Bounds", "bounds_of"]


@dataclass(frozen=True)
class Bounds:
    """Of K lights, see :func:`torchpt.lights.tree.build`; float64, detached."""

    low: Tensor  # (3, K)
    high: Tensor  # (3, K)
    axis: Tensor  # (3, K)
    cos_o: Tensor  # (K,)
    cos_e: Tensor  # (K,)
    intensity: Tensor  # (K,)


def bounds_of(lights: Lights, power: Tensor, boxes: tuple[Tensor, Tensor]) -> Bounds:
    """The bounds of all rows that lie somewhere, which come before those infinitely far.

    Args:
        lights: the table.
        power: of all rows ``(K,)``.
        boxes: lower and upper corners ``(3, E)`` of boxes about the E primitives that emit, which come first.
    """
    near = tuple(kind for kind in lights.kinds if kind not in DISTANT)
    number = torch.zeros_like(lights.area, dtype=torch.int64) if lights.kind is None else lights.kind
    count = int((number < len(near)).sum())
    number = number[:count]
    axis, radiance, place = (x[:, :count].detach().double() for x in (lights.normal, lights.radiance, lights.p0))
    surfaces = boxes[0].shape[1]
    low, high = (torch.cat((box.double(), place[:, surfaces:]), 1) for box in boxes)
    cos_o, cos_e = torch.ones_like(place[0]), torch.zeros_like(place[0])
    # Seen face on a flat light is as bright as any of its power; a convex one shows a quarter of its area on average.
    intensity = power[:count].detach().double() / math.pi
    for k, kind in enumerate(near):
        rows = (number == k).nonzero().squeeze(1)
        if kind == "spot":
            # Whole within the beam, and beyond its edge up to the cutoff: see torchpt.lights.spot.
            cutoff, slope = (x.index_select(0, rows).detach().double() for x in lights.e1[:2])
            cos_o[rows], cos_e[rows] = torch.cos((cutoff - 1.0 / slope).clamp_min(0.0)), torch.cos(1.0 / slope)
            intensity[rows] = luminance(radiance.index_select(1, rows).abs())
        elif kind not in ("triangle", "rectangle", "disk"):
            cos_o[rows] = -1.0
            intensity[rows] *= 0.25
    return Bounds(low, high, axis, cos_o, cos_e, intensity)
