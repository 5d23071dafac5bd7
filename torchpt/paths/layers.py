"""Layers (AOVs): pictures of something other than light, one entry each, and the values of those of first surfaces.

A layer is a class of this file with a name; :data:`LAYERS` finds it. One more is one more class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import dot, take
from torchpt.paths.state import StageContext
from torchpt.paths.surface import TexturePoint, parameters_at, shading_normal, texture_point_at
from torchpt.physics.film import Film
from torchpt.physics.shapes import interact, surface_uv
from torchpt.physics.shapes.geometry import Hit, Interaction
from torchpt.physics.world import World

__all__ = ["LAYERS", "FilmLayer", "Layer", "Seen", "SurfaceLayer", "surface_layer", "values", "weighted"]


# ---- Two sorts of layers: what the first surface is, and what the film knows


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
        name: as ``film.aovs`` lists it.
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
        """Return the values ``(C, n)`` at first surfaces; a pure function of tensors, traced for the compiled loop too."""
        raise NotImplementedError


class FilmLayer(Layer):
    """A layer that the film makes of its sums of radiance."""

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """Return the layer ``(H, W, C)`` float64.

        Args:
            film: sums of radiance.
            counts: samples that each pixel of the picture holds ``(pixels,)``; of a pilot both of its values.
        """
        raise NotImplementedError


# ---- The layers, in the order that lists name them


class Albedo(SurfaceLayer):
    """The material's reflectance, textures included."""

    name = "albedo"
    channels = ("albedo.R", "albedo.G", "albedo.B")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        materials = seen.world.materials
        parameters = parameters_at(seen.world, seen.model, take(materials.row, seen.at.slot), seen.at, seen.point)
        return materials.models[seen.model].albedo(parameters)


class Normal(SurfaceLayer):
    """The shading normal in the world, on the shape's own outside, normal and bump maps included."""

    name = "normal"
    channels = ("normal.X", "normal.Y", "normal.Z")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return shading_normal(seen.world, seen.model, seen.d, seen.at, seen.point)


class Depth(SurfaceLayer):
    """The distance along the camera ray."""

    name = "depth"
    channels = ("Z",)
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return seen.hit.t[None]


class Position(SurfaceLayer):
    """The point in the world."""

    name = "position"
    channels = ("position.X", "position.Y", "position.Z")
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return seen.at.p + seen.centre.to(seen.dtype)[:, None]


class Uv(SurfaceLayer):
    """Texture coordinates, before a texture's own transform."""

    name = "uv"
    channels = ("uv.U", "uv.V")
    uv = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return surface_uv(seen.world, seen.at)


class ObjectId(SurfaceLayer):
    """The order of the shape in the scene, from 1; a pixel shows what its first sample met."""

    name = "object_id"
    channels = ("object_id",)
    averaged = False

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return take(seen.world.geometry.object_id, seen.at.slot).to(seen.dtype)[None]


class Alpha(SurfaceLayer):
    """The share of the pixel that surfaces cover, by their opacity; 0 where the sky is seen. The picture's alpha channel."""

    name = "alpha"
    channels = ("A",)

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return torch.ones_like(seen.hit.t)[None]


class Variance(FilmLayer):
    """The variance of the picture's mean, from the spread of its randomizations; infinite where there is only one."""

    name = "variance"
    channels = ("variance.R", "variance.G", "variance.B")
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """See :class:`FilmLayer`."""
        variance = film.variance()
        return torch.full_like(film.mean(), torch.inf) if variance is None else variance


class Samples(FilmLayer):
    """How many samples of light the pixel is a mean of: `sampler.adaptive` says where; a pilot may hold twice as many."""

    name = "samples"
    channels = ("samples",)
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """See :class:`FilmLayer`."""
        return counts.double().reshape(film.height, film.width, 1)


#: The layers of this file by name.
LAYERS: dict[str, type[Layer]] = {
    kind.name: kind
    for kind in tuple(vars().values())
    if isinstance(kind, type) and issubclass(kind, Layer) and kind.name
}


# ---- Values at first surfaces


def surface_layer(name: str) -> type[SurfaceLayer]:
    """Return the layer of a name, which is one of the first surface."""
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
    """Return layers times the weights ``(N,)`` of their samples, where they are averaged."""
    return {name: value * weight if surface_layer(name).averaged else value for name, value in layers.items()}
