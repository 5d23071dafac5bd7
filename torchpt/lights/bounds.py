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


def bounds_of(lights: Lights, power: Tensor) -> Bounds:
    """The bounds of all rows that lie somewhere, which come before those infinitely far.

    Args:
        lights: the table.
        power: of all rows ``(K,)``.
    """
    near = tuple(kind for kind in lights.kinds if kind not in DISTANT)
    number = torch.zeros_like(lights.area, dtype=torch.int64) if lights.kind is None else lights.kind
    count = int((number < len(near)).sum())
    number = number[:count]
    p0, e1, e2, axis, radiance = (
        x[:, :count].detach().double() for x in (lights.p0, lights.e1, lights.e2, lights.normal, lights.radiance)
    )
    low, high = p0.clone(), p0.clone()
    cos_o, cos_e = torch.ones_like(p0[0]), torch.zeros_like(p0[0])
    # Seen face on a flat light is as bright as any of its power; a convex one shows a quarter of its area on average.
    intensity = power[:count].detach().double() / math.pi
    for k, kind in enumerate(near):
        rows = (number == k).nonzero().squeeze(1)
        at, a, b = (x.index_select(1, rows) for x in (p0, e1, e2))
        if kind in ("triangle", "rectangle"):
            corners = [at, at + a, at + b, *([at + a + b] if kind == "rectangle" else [])]
            low[:, rows], high[:, rows] = torch.stack(corners).amin(0), torch.stack(corners).amax(0)
            continue
        half = torch.zeros_like(at)
        if kind == "disk":
            half = (a * a + b * b).sqrt()
        elif kind == "sphere":
            half = a[0].abs().expand_as(at)
        elif kind == "quadric":
            assert lights.quadric is not None and lights.quadrics is not None
            c = lights.quadrics.e3.detach().double().index_select(1, lights.quadric.index_select(0, rows))
            half = (a * a + b * b).sqrt() + c.abs()
        low[:, rows], high[:, rows] = at - half, at + half
        if kind == "spot":
            # Whole within the beam, and beyond its edge up to the cutoff: see torchpt.lights.spot.
            falling = 1.0 / a[1]
            cos_o[rows], cos_e[rows] = torch.cos((a[0] - falling).clamp_min(0.0)), torch.cos(falling)
            intensity[rows] = luminance(radiance.index_select(1, rows).abs())
        elif kind != "disk":
            cos_o[rows] = -1.0
            intensity[rows] *= 0.25
    return Bounds(low, high, axis, cos_o, cos_e, intensity)
