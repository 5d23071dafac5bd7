"""Layers of the first surface, without light transport (arbitrary output variables)."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from torchpt.integrators import LAYERS
from torchpt.integrators.layer import Seen, SurfaceLayer
from torchpt.integrators.surfaces import texture_point_at
from torchpt.integrators.vertex import StageContext
from torchpt.math.vectors import dot
from torchpt.records import Hit
from torchpt.shapes import interact

__all__ = ["surface_layer", "values", "weighted"]


def surface_layer(name: str) -> type[SurfaceLayer]:
    """The layer of a name, which is one of the first surface."""
    layer = LAYERS[name]
    assert issubclass(layer, SurfaceLayer)
    return layer


def values(
    names: tuple[str, ...], context: StageContext, model: int, o: Tensor, d: Tensor, hit: Hit, centre: Tensor
) -> dict[str, Tensor]:
    """Return the layers ``names``, each ``(C, n)``, where rays ``o, d`` hit surfaces of BSDF model number ``model``.

    ``centre``: see :class:`torchpt.integrators.wave.Wave`.
    """
    world = context.world
    at = interact(world, o, d, hit, context.slide)
    if context.slide:
        hit = replace(hit, t=dot(at.p - o, d))
    point = texture_point_at(world, model, at, context.pixel)
    seen = Seen(world, model, d, hit, at, point, centre, context.plan.dtype)
    found = {name: surface_layer(name).values(seen) for name in names}
    return found if hit.chance is None else {name: value * hit.chance for name, value in found.items()}


def weighted(layers: dict[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    """Layers times the weights ``(N,)`` of their samples, where they are averaged."""
    return {name: value * weight if surface_layer(name).averaged else value for name, value in layers.items()}
