"""Where lights lie and where they shine: what the light tree asks of the table's rows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchpt.lights.base import COLUMNS
from torchpt.lights.surface import emitter
from torchpt.records import Lights

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
    near = [kind for kind in map(emitter, lights.kinds) if not kind.distant]
    number = torch.zeros_like(lights.area, dtype=torch.int64) if lights.kind is None else lights.kind
    count = int((number < len(near)).sum())
    number = number[:count]
    columns = {name: getattr(lights, name)[..., :count].detach().double() for name in COLUMNS}
    place, surfaces = columns["p0"], boxes[0].shape[1]
    low, high = (torch.cat((box.double(), place[:, surfaces:]), 1) for box in boxes)
    cos_o, cos_e = torch.empty_like(place[0]), torch.empty_like(place[0])
    intensity = power[:count].detach().double() / math.pi
    for k, kind in enumerate(near):
        rows = (number == k).nonzero().squeeze(1)
        at = replace(lights, **{name: column.index_select(-1, rows) for name, column in columns.items()})
        cone = kind.bounds(at, intensity[rows])
        cos_o[rows], cos_e[rows], intensity[rows] = cone.cos_o, cone.cos_e, cone.intensity
    return Bounds(low, high, columns["normal"], cos_o, cos_e, intensity)
