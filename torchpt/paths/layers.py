"""Layers (AOVs): pictures of quantities other than radiance, and their values at first surfaces.

A layer is a class of this file with a name; :data:`LAYERS` finds it. To add a layer, add a class. Engines evaluate the layers
of first surfaces by :func:`values`, for n lanes that hit one BSDF model; :mod:`torchpt.rendering.picture` calls
:meth:`FilmLayer.of` for the others once the film is complete. A film adds samples up and divides by their number.
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


# ---- Base classes: layers of the first surface, and layers of the film's sums


@dataclass(frozen=True)
class Seen:
    """First surface points of one BSDF model, as layers read them; n lanes.

    Attributes:
        world: the scene's tensors.
        model: index of the BSDF model.
        d: directions ``(3, n)`` of the camera rays.
        hit: their hits; ``t`` is the distance, as ``d`` is unit.
        at: the surface points: positions, normals, and ``slot (n,)``, the index of the primitive or instance.
        point: texture coordinates of the points; None where the model has no textures.
        centre: ``(3,)`` float64, the origin of the lanes' coordinates in the scene: adding it gives coordinates of the scene,
            but in the world's unit.
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
    """Base class of layers.

    Attributes:
        name: its entry in ``film.aovs``.
        channels: names of its channels in EXR files.
        light: True: made of radiance, so integrators that estimate none do not have it.
    """

    name: ClassVar[str] = ""
    channels: ClassVar[tuple[str, ...]] = ()
    light: ClassVar[bool] = False


class SurfaceLayer(Layer):
    """A quantity of the first surface; 0 where a camera ray hits nothing, which counts in the mean of a pixel.

    Attributes:
        averaged: True: a pixel is the mean of its samples. False: its first sample, for identifiers, which have no mean.
        length: True: a length or position: ``values`` are in the world's unit, and the picture is converted to scene units.
        uv: True: needs texture coordinates, even in a scene without textures.
    """

    averaged: ClassVar[bool] = True
    length: ClassVar[bool] = False
    uv: ClassVar[bool] = False

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the values ``(C, n)`` at first surfaces, one row a channel.

        A pure function of tensors: kernels are traced from it.
        """
        raise NotImplementedError


class FilmLayer(Layer):
    """A layer computed from the film's sums of radiance."""

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """Return the layer ``(H, W, C)`` float64.

        Args:
            film: sums of radiance.
            counts: number of samples of each pixel ``(pixels,)``; of an error probe, which is sampled twice, those of both
                times.
        """
        raise NotImplementedError


# ---- The layers, in the order in which lists show them


class Albedo(SurfaceLayer):
    """The material's reflectance, textures included."""

    name = "albedo"
    channels = ("albedo.R", "albedo.G", "albedo.B")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the reflectances ``(3, n)``."""
        materials = seen.world.materials
        parameters = parameters_at(seen.world, seen.model, take(materials.row, seen.at.slot), seen.at, seen.point)
        return materials.models[seen.model].albedo(parameters)


class Normal(SurfaceLayer):
    """The shading normal in the world, on the shape's own outside, normal and bump maps included."""

    name = "normal"
    channels = ("normal.X", "normal.Y", "normal.Z")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the normals ``(3, n)``, unit."""
        return shading_normal(seen.world, seen.model, seen.d, seen.at, seen.point)


class Depth(SurfaceLayer):
    """The distance along the camera ray, 0 where it hits nothing; over `alpha` it is the mean over what surfaces cover."""

    name = "depth"
    channels = ("Z",)
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the distances ``(1, n)``."""
        return seen.hit.t[None]


class Position(SurfaceLayer):
    """The point in the world."""

    name = "position"
    channels = ("position.X", "position.Y", "position.Z")
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the points ``(3, n)``."""
        return seen.at.p + seen.centre.to(seen.dtype)[:, None]


class Uv(SurfaceLayer):
    """Texture coordinates, before a texture's own transform."""

    name = "uv"
    channels = ("uv.U", "uv.V")
    uv = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the texture coordinates ``(2, n)``."""
        return surface_uv(seen.world, seen.at)


class ObjectId(SurfaceLayer):
    """The index of the shape in the scene, from 1; a pixel shows the hit of its first sample."""

    name = "object_id"
    channels = ("object_id",)
    averaged = False

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return the indices ``(1, n)``, as floats."""
        return take(seen.world.geometry.object_id, seen.at.slot).to(seen.dtype)[None]


class Alpha(SurfaceLayer):
    """The fraction of the pixel that surfaces cover, opacity included: the alpha channel of the picture.

    Its value is 1 at any surface that a camera ray stops at; rays that hit nothing count as 0 in the mean.
    """

    name = "alpha"
    channels = ("A",)

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """Return ones ``(1, n)``."""
        return torch.ones_like(seen.hit.t)[None]


class Variance(FilmLayer):
    """The variance of the pixel's mean, estimated from the spread of its randomizations; infinite with only one."""

    name = "variance"
    channels = ("variance.R", "variance.G", "variance.B")
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """Return the variances ``(H, W, 3)``."""
        variance = film.variance()
        return torch.full_like(film.mean(), torch.inf) if variance is None else variance


class Samples(FilmLayer):
    """The number of radiance samples of the pixel. It varies with `sampler.adaptive`; an error probe may have twice as many."""

    name = "samples"
    channels = ("samples",)
    light = True

    @classmethod
    def of(cls, film: Film, counts: Tensor) -> Tensor:
        """Return the numbers of samples ``(H, W, 1)``."""
        return counts.double().reshape(film.height, film.width, 1)


#: All layers of this file by name: the classes above that have one, which the base classes do not.
LAYERS: dict[str, type[Layer]] = {
    kind.name: kind
    for kind in tuple(vars().values())
    if isinstance(kind, type) and issubclass(kind, Layer) and kind.name
}


# ---- Values at first surfaces


def surface_layer(name: str) -> type[SurfaceLayer]:
    """Return the class of a layer of the first surface."""
    layer = LAYERS[name]
    assert issubclass(layer, SurfaceLayer)
    return layer


def values(
    names: tuple[str, ...], context: StageContext, model: int, o: Tensor, d: Tensor, hit: Hit, centre: Tensor
) -> dict[str, Tensor]:
    """Return the values of layers at first surfaces, each ``(C, n)``, by name.

    Args:
        names: names of layers of the first surface.
        context: inputs of stages that are the same for all lanes.
        model: index of the BSDF model that all rays hit.
        o: ray origins ``(3, n)``.
        d: unit ray directions ``(3, n)``.
        hit: hits of the rays.
        centre: ``(3,)`` float64 origin of the lanes' coordinates, as in :class:`torchpt.paths.wave.Wave`.
    """
    world = context.world
    at = interact(world, o, d, hit, follow_ray=context.follow_ray)
    if context.follow_ray:  # the distance follows the point, which was intersected anew
        hit = replace(hit, t=dot(at.p - o, d))
    point = texture_point_at(world, model, at, context.pixel)
    seen = Seen(world=world, model=model, d=d, hit=hit, at=at, point=point, centre=centre, dtype=context.plan.dtype)
    found = {name: surface_layer(name).values(seen) for name in names}
    # `chance` is 1, with the derivative of the probability that the ray passed the surfaces before.
    return found if hit.chance is None else {name: value * hit.chance for name, value in found.items()}


def weighted(layers: dict[str, Tensor], weight: Tensor) -> dict[str, Tensor]:
    """Return averaged layers times the filter weights ``(N,)`` of their samples, and the others as they are."""
    return {name: value * weight if surface_layer(name).averaged else value for name, value in layers.items()}
