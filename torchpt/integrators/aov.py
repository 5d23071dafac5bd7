"""Layers of the first surface, without light transport (arbitrary output variables)."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchpt.integrators import LAYERS
from torchpt.integrators.layer import Seen, SurfaceLayer
from torchpt.integrators.surfaces import texture_point_at
from torchpt.math.vectors import dot
from torchpt.records import Hit, World
from torchpt.shapes import interact

__all__ = ["surface_layer", "values", "weighted"]


def surface_layer(name: str) -> type[SurfaceLayer]:
    """The layer of a name, which is one of the first surface."""
    layer = LAYERS[name]
    assert issubclass(layer, SurfaceLayer)
    return layer


def values(
    names: tuple[str, ...],
    world: World,
    model: int,
    o: Tensor,
    d: Tensor,
    hit: Hit,
    centre: Tensor,
    dtype: torch.dtype,
    pixel: Tensor | None,
    slide: bool = False,
) -> dict[str, Tensor]:
    """The layers ``names``, each ``(C, n)``, where rays ``o, d`` hit surfaces of one model."""
    at = interact(world, o, d, hit, slide)
    if slide:
        hit = replace(hit, t=dot(at.p - o, d))
    seen = Seen(world, model, d, hit, at, texture_point_at(world, model, at, pixel), centre, dtype)
    found = {name: surface_layer(name).values(seen) for name in names}
    return found if hit.chance is None else {name: value * hit.chance for name, value in found.items()}


def weighted(layers: dict[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    """Layers times the weights ``(N,)`` of their samples, where they are averaged."""
    return {name: value * weight if surface_layer(name).averaged else value for name, value in layers.items()}
