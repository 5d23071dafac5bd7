"""Layers (AOVs): what a kind of layer is, and the layers of first surfaces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import dot
from torchpt.paths.integrators import LAYERS
from torchpt.paths.state import StageContext
from torchpt.paths.surface import TexturePoint, texture_point_at
from torchpt.physics.film import Film
from torchpt.physics.shapes import interact
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.world import World

__all__ = ["FilmLayer", "Layer", "Seen", "SurfaceLayer", "surface_layer", "values", "weighted"]


# ---- What a layer of a picture (an AOV) is: what the first surface is, or what the film knows


@dataclass(frozen=True)
class Seen:
    """First surfaces of one BSDF model; n lanes.

    Attributes:
        world: the scene's tensors.
        model: number of the BSDF model.
        d: directions ``(3, n)`` of the camera rays.
        hit: what they met; ``t`` is the distance.
        at: the points.
        point: where textures are read; None where the model reads none.
        centre: ``(3,)`` float64, from the lanes' coordinates to the scene's own.
        dtype: of the lanes.
    """

    world: World
    model: int
    d: Tensor
    hit: Hit
    at: Interaction
    point: TexturePoint | None
    centre: Tensor
    dtype: torch.dtype


class Layer:
    """A layer of pictures.

    Attributes:
        name: what ``film.aovs`` calls it.
        channels: their names in EXR files.
        light: whether it is of the light, so that an integrator without light has none.
    """

    name: ClassVar[str] = ""
    channels: ClassVar[tuple[str, ...]] = ()
    light: ClassVar[bool] = False


class SurfaceLayer(Layer):
    """A layer of what the first surface is; 0 where there is none.

    Attributes:
        averaged: whether a pixel shows the mean of its samples; else it shows its first one, as names have no average.
        length: whether it is a length, or a place: counted in the scene's units.
        uv: whether it reads texture coordinates, whether or not a texture does.
    """

    averaged: ClassVar[bool] = True
    length: ClassVar[bool] = False
    uv: ClassVar[bool] = False

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """The values ``(C, n)`` at first surfaces; a pure function of tensors, traced for the compiled loop too."""
        raise NotImplementedError


class FilmLayer(Layer):
    """A layer that the film makes of its sums of radiance."""

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """The layer ``(H, W, C)`` float64.

        Args:
            film: sums of radiance.
            counts: samples that each pixel of the picture holds ``(pixels,)``; of a pilot both of its values.
        """
        raise NotImplementedError


# ---- Layers of the first surface, without light transport (arbitrary output variables)


def surface_layer(name: str) -> type[SurfaceLayer]:
    """The layer of a name, which is one of the first surface."""
    layer = LAYERS[name]
    assert issubclass(layer, SurfaceLayer)
    return layer


def values(
    names: tuple[str, ...], context: StageContext, model: int, o: Tensor, d: Tensor, hit: Hit, centre: Tensor
) -> dict[str, Tensor]:
    """Return the layers ``names``, each ``(C, n)``, where rays ``o, d`` hit surfaces of BSDF model number ``model``.

    ``centre``: see :class:`torchpt.paths.wave.Wave`.
    """
    world = context.world
    at = interact(world, o, d, hit, context.follow_shape)
    if context.follow_shape:
        hit = replace(hit, t=dot(at.p - o, d))
    point = texture_point_at(world, model, at, context.pixel)
    seen = Seen(world, model, d, hit, at, point, centre, context.plan.dtype)
    found = {name: surface_layer(name).values(seen) for name in names}
    return found if hit.chance is None else {name: value * hit.chance for name, value in found.items()}


def weighted(layers: dict[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    """Layers times the weights ``(N,)`` of their samples, where they are averaged."""
    return {name: value * weight if surface_layer(name).averaged else value for name, value in layers.items()}
