"""Points on surfaces with their materials resolved: textures, shading normals, bumps, opacity, footprints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchpt.math.vectors import Frame, cross, dot, normalize, take
from torchpt.paths.perturbed_normals import PerturbedNormal, perturb_normal
from torchpt.physics import bsdfs
from torchpt.physics.shapes import surface_uv, vertex_colors
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.textures import MaterialTextures, NodeMap, TextureBinding, TexturePoint
from torchpt.physics.world import World

__all__ = [
    "Surface",
    "TexturePoint",
    "emission_map",
    "opacity_map",
    "parameters_at",
    "shading_normal",
    "surface_at",
    "texture_point_at",
]


#: Seen more slantingly than this (as a cosine), a footprint grows no further.
_SLANT = 1e-3


def texture_point_at(world: World, number: int, at: Interaction, pixel: Tensor | None) -> TexturePoint | None:
    """Where the textures of model ``number`` are read; None where it reads none.

    Args:
        world: the scene's tensors.
        number: of the model.
        at: the points.
        pixel: how large a pixel is in the world, see :meth:`torchpt.cameras.Camera.pixel`; None: a point.
    """
    textures = world.materials.textures[number]
    if textures is None:
        return None
    return TexturePoint(
        surface_uv(world, at) if "uv" in textures.reads else None,
        _footprint(at, pixel) if textures.filtered and pixel is not None else None,
        vertex_colors(world, at) if "colors" in textures.reads else None,
    )


def _footprint(at: Interaction, pixel: Tensor) -> Tensor:
    """Area ``(N,)`` in texture coordinates of what a pixel covers of the surface; 0 where it has no coordinates.

    Every vertex of a path counts as if the camera saw it directly (Pharr, Jakob, Humphreys, *Physically Based Rendering*,
    4th edition, 10.1.3). Of the ellipse that a pixel is on the surface, the area: filters here are round.
    """
    assert at.tangent is not None and at.bitangent is not None
    away = torch.addcmul(pixel[0:3, None], at.p, pixel[3], value=-1)
    square = dot(away, away)
    cosine = dot(normalize(away), at.ng).abs().clamp_min(_SLANT)
    across = cross(at.tangent, at.bitangent)
    stretch = dot(across, across)  # of the area, squared
    some = stretch > 0
    stretch = torch.where(some, torch.where(some, stretch, 1.0).sqrt(), torch.inf)
    return square * (pixel[4] * pixel[4]) / (cosine * stretch)


@dataclass(frozen=True)
class Surface:
    """A surface point with its material resolved."""

    frame: Frame  # about the shading normal, turned to the side of wo where light does not pass through
    side: Tensor | None  # (N,) -1 where it was turned around; None where light passes through
    front_mask: Tensor | None  # (N,) 0 on the back of one-sided surfaces; None where there are none
    parameters: bsdfs.Parameters  # lane values of the BSDF
    wo: Tensor  # (3, N) local
    perturbed_normal: PerturbedNormal | None  # None where no map bends the normals


def surface_at(world: World, number: int, d: Tensor, at: Interaction, pixel: Tensor | None = None) -> Surface:
    """Resolve the material at surface points.

    Args:
        world: the scene's tensors.
        number: of the model that all of them have.
        d: directions ``(3, N)`` of the rays that came.
        at: the points.
        pixel: see :func:`texture_point_at`.
    """
    model, row = world.materials.models[number], take(world.materials.row, at.slot)
    textures = world.materials.textures[number]
    point = texture_point_at(world, number, at, pixel)
    ns, side, front_mask, perturbed_normal = at.ns, None, None, None
    if not model.transmits:
        side = torch.copysign(torch.ones_like(ns[0]), -dot(d, ns).detach())
        both = world.materials.two_sided[number]
        if both is not None:
            front_mask = ((side > 0) | take(both, row)).to(side.dtype)
    if textures is not None and (textures.normal is not None or textures.bump is not None):
        assert point is not None
        frame, perturbed_normal = _mapped(world, textures, row, point, d, at, side)
    else:
        ns = ns if side is None else ns * side
        frame = Frame.along(ns, at.tangent) if model.anisotropic and at.tangent is not None else Frame.about(ns)
    return Surface(
        frame, side, front_mask, parameters_at(world, number, row, at, point), frame.to_local(-d), perturbed_normal
    )


def parameters_at(
    world: World, number: int, row: Tensor, at: Interaction, point: TexturePoint | None
) -> bsdfs.Parameters:
    """Lane values of the BSDF ``number`` at rows ``(N,)``; ``point`` where textures are read."""
    values, textures = bsdfs.gather(world.materials.parameters[number], row), world.materials.textures[number]
    if textures is None:
        return values
    assert point is not None
    return world.materials.models[number].prepare(_filled(world, values, textures.readings, row, point))


def _filled(
    world: World,
    values: bsdfs.Parameters,
    readings: dict[str, Any],
    row: Tensor,
    point: TexturePoint,
) -> bsdfs.Parameters:
    """Values with those that textures give."""
    filled = dict(values)
    for key, reading in readings.items():
        if isinstance(reading, TextureBinding):
            filled[key] = _read(world, reading, row, point)
        else:
            filled[key] = _filled(world, values.get(key, {}), reading, row, point)
    return filled


def _read(world: World, binding: TextureBinding, row: Tensor, point: TexturePoint) -> Tensor:
    table = world.textures.tables[binding.table]
    point = point if binding.filtered else point.bare
    return table.look_up(take(binding.nodes, row), point, binding.channel is None)


def _mapped_value(world: World, maps: NodeMap, at: Interaction, coloured: bool) -> Tensor:
    """What textures by primitive give at points; any number where a surface has none."""
    row, point = take(maps.nodes, at.slot).clamp_min(0), TexturePoint(surface_uv(world, at))
    first, *others = (world.textures.tables[number] for number in maps.tables)
    if maps.table is None:
        return first.look_up(row, point, coloured)
    which = take(maps.table, at.slot)
    value = first.look_up(torch.where(which == 0, row, 0), point, coloured)
    for k, table in enumerate(others, 1):
        mine = which == k
        value = torch.where(mine, table.look_up(torch.where(mine, row, 0), point, coloured), value)
    return value


def opacity_map(world: World, at: Interaction) -> Tensor:
    """What textures make of the opacity ``(N,)`` of surfaces; 1 where they have no such texture."""
    maps = world.textures.opacity
    assert maps is not None
    value = _mapped_value(world, maps, at, False)
    value = torch.addcmul(take(maps.bias, at.slot), take(maps.factor, at.slot), value)
    if maps.cutoff is not None:
        cutoff = take(maps.cutoff, at.slot)
        value = torch.where(cutoff < 0, value, (value >= cutoff).to(value.dtype))
    return torch.where(take(maps.nodes, at.slot) < 0, 1.0, value)


def emission_map(world: World, at: Interaction) -> Tensor:
    """What textures make of the emission of surfaces ``(3, N)``; 1 where they have no such texture."""
    maps = world.textures.emission
    assert maps is not None
    value = _mapped_value(world, maps, at, True)
    return torch.where(take(maps.nodes, at.slot) < 0, 1.0, value)


def shading_normal(world: World, number: int, d: Tensor, at: Interaction, point: TexturePoint | None) -> Tensor:
    """The shading normal ``(3, N)`` on the shape's own outside, maps included."""
    textures = world.materials.textures[number]
    if textures is None or (textures.normal is None and textures.bump is None):
        return at.ns
    assert point is not None
    row = take(world.materials.row, at.slot)
    side = torch.copysign(torch.ones_like(d[0]), -dot(d, at.ns))
    return _mapped(world, textures, row, point, d, at, side)[0].n * side


def _mapped(
    world: World,
    textures: MaterialTextures,
    row: Tensor,
    point: TexturePoint,
    d: Tensor,
    at: Interaction,
    side: Tensor | None,
) -> tuple[Frame, PerturbedNormal]:
    """The frame about the normal of a normal or bump map, and what the map did."""
    local = None if textures.normal is None else _read(world, textures.normal, row, point)
    slope = None
    if local is None:
        assert textures.bump is not None
        table = world.textures.tables[textures.bump.table]
        point = point if textures.bump.filtered else point.bare
        slope = table.slope(take(textures.bump.nodes, row), point)
    return perturb_normal(textures, row, local, slope, d, at, side)
