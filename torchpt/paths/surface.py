"""Surface points with their materials resolved: textures, shading normals, bump maps, opacity, texture footprints.

Stages call :func:`surface_at` for n lanes that all hit one BSDF model, ``number`` in ``world.materials.models``. A primitive or
instance, ``at.slot (n,)``, has a material; ``row (n,)`` is this material's row in the parameter tables of the model. A texture
in use is a *node*, a row of one of ``world.textures.tables``; -1 stands for no texture.
"""

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


#: Lower bound of the cosine by which a footprint grows at grazing angles: it grows to a thousand times its area.
_SLANT = 1e-3


def texture_point_at(world: World, number: int, at: Interaction, pixel: Tensor | None) -> TexturePoint | None:
    """Return the texture coordinates, footprints and vertex colours of points; None where the model has no textures.

    Args:
        world: the scene's tensors.
        number: index of the BSDF model.
        at: the surface points.
        pixel: ``(5,)`` footprint of a pixel, see :meth:`torchpt.physics.cameras.base.Camera.pixel`; None: textures are not
            filtered.
    """
    textures = world.materials.textures[number]
    if textures is None:
        return None
    return TexturePoint(
        uv=surface_uv(world, at) if "uv" in textures.reads else None,
        footprint=_footprint(at, pixel) if textures.filtered and pixel is not None else None,
        colors=vertex_colors(world, at) if "colors" in textures.reads else None,
    )


def _footprint(at: Interaction, pixel: Tensor) -> Tensor:
    """Return the area ``(N,)`` that a pixel covers on the surface, in texture coordinates; 0 where a surface has none.

    Every vertex of a path is treated as if the camera saw it directly (Pharr, Jakob, Humphreys, *Physically Based Rendering*,
    4th edition, 10.1.3). Texture filters are isotropic, so the area of the pixel's ellipse is enough.
    """
    assert at.tangent is not None and at.bitangent is not None
    eye, w, spread = pixel[0:3, None], pixel[3], pixel[4]  # see Camera.pixel: the camera lies in direction `eye - w p`
    to_camera = torch.addcmul(eye, at.p, w, value=-1)
    square = dot(to_camera, to_camera)
    cosine = dot(normalize(to_camera), at.ng).abs().clamp_min(_SLANT)
    across = cross(at.tangent, at.bitangent)
    stretch = dot(across, across)  # surface area for one unit of area in texture coordinates, squared
    textured = stretch > 0
    # The inner `where` keeps the derivative of the root finite.
    stretch = torch.where(textured, torch.where(textured, stretch, 1.0).sqrt(), torch.inf)
    return square * (spread * spread) / (cosine * stretch)


@dataclass(frozen=True)
class Surface:
    """Surface points with their material resolved, of one BSDF model."""

    frame: Frame  # about the shading normal, flipped on the back unless the model transmits
    side: Tensor | None  # (N,) -1 on the back, else 1; None where the model transmits
    outward: Tensor | None  # (3, N) normal by which the side is told, on that side; None where the model transmits
    front_mask: Tensor | None  # (N,) 0 on the back of one-sided surfaces; None where there are none
    parameters: bsdfs.Parameters  # parameters of the BSDF at each lane, textures included
    wo: Tensor  # (3, N) direction to the previous vertex, see `local_wo`
    perturbed_normal: PerturbedNormal | None  # None without a normal or bump map

    def local_wo(self, w: Tensor) -> Tensor:
        """Return unit directions ``w (3, N)`` to viewers on this side of the surface, in the frame.

        Near outlines of smooth shading the normal turns away from the viewer. What transmits nothing then reflects as if it
        were seen from the mirror image of ``w``: a dark rim would end where the geometry has no edge, and gradients miss that.
        """
        return _upper(self.frame, w, self.side)


def _upper(frame: Frame, w: Tensor, side: Tensor | None) -> Tensor:
    """Return :meth:`Surface.local_wo`."""
    if side is None:
        return frame.to_local(w)
    return torch.stack((dot(frame.s, w), dot(frame.t, w), dot(frame.n, w).abs()))


def surface_at(
    world: World,
    number: int,
    d: Tensor,
    at: Interaction,
    pixel: Tensor | None = None,
    *,
    dark_rims: bool = False,
) -> Surface:
    """Return surface points with their materials resolved.

    Args:
        world: the scene's tensors.
        number: index of the BSDF model that all points have.
        d: directions ``(3, N)`` of the incoming rays.
        at: the surface points.
        pixel: ``(5,)`` footprint of a pixel, as for :func:`texture_point_at`; None: textures are not filtered.
        dark_rims: True: shading normals tell from which side an opaque surface is seen, as in Mitsuba: near outlines some face
            away, and show the dark inside of a body; mapped normals that face away are mirrored. False: geometric normals do.
    """
    model, row = world.materials.models[number], take(world.materials.row, at.slot)
    textures = world.materials.textures[number]
    point = texture_point_at(world, number, at, pixel)
    ns, side, outward, front_mask, perturbed_normal = at.ns, None, None, None, None
    if not model.transmits:
        outward = at.ns if dark_rims else at.ng
        side = _side(d, outward)
        outward = outward * side
        two_sided = world.materials.two_sided[number]
        if two_sided is not None:
            front_mask = ((side > 0) | take(two_sided, row)).to(side.dtype)
    if textures is not None and (textures.normal is not None or textures.bump is not None):
        assert point is not None
        frame, perturbed_normal = _perturbed_frame(world, textures, row, point, d, at, side, dark_rims)
    else:
        ns = ns if side is None else ns * side
        frame = Frame.along(ns, at.tangent) if model.anisotropic and at.tangent is not None else Frame.about(ns)
    return Surface(
        frame=frame,
        side=side,
        outward=outward,
        front_mask=front_mask,
        parameters=parameters_at(world, number, row, at, point),
        wo=_upper(frame, -d, side),
        perturbed_normal=perturbed_normal,
    )


def _side(d: Tensor, n: Tensor) -> Tensor:
    """Return 1 where rays along ``d (3, N)`` meet the side of the normals ``n (3, N)``, else -1 ``(N,)``."""
    return torch.copysign(torch.ones_like(d[0]), -dot(d, n).detach())


def parameters_at(
    world: World, number: int, row: Tensor, at: Interaction, point: TexturePoint | None
) -> bsdfs.Parameters:
    """Return the parameters of BSDF model ``number`` for each lane, at rows ``row (N,)`` of its tables, textures included.

    ``point``: texture coordinates of the lanes; needed if the model has textures.
    """
    values, textures = bsdfs.gather(world.materials.parameters[number], row), world.materials.textures[number]
    if textures is None:
        return values
    assert point is not None
    return world.materials.models[number].prepare(_with_texture_values(world, values, textures.bindings, row, point))


def _with_texture_values(
    world: World,
    values: bsdfs.Parameters,
    bindings: dict[str, Any],
    row: Tensor,
    point: TexturePoint,
) -> bsdfs.Parameters:
    """Return the parameters with textured ones replaced by their texture values.

    ``bindings`` has a :class:`TextureBinding` for each textured parameter, in nested dicts where ``values`` nests them.
    """
    filled = dict(values)
    for key, binding in bindings.items():
        if isinstance(binding, TextureBinding):
            filled[key] = _texture_values(world, binding, row, point)
        else:
            filled[key] = _with_texture_values(world, values.get(key, {}), binding, row, point)
    return filled


def _texture_values(world: World, binding: TextureBinding, row: Tensor, point: TexturePoint) -> Tensor:
    """Return the texture values of a parameter, a colour ``(3, n)`` or a number ``(n,)``, for materials ``row (n,)``."""
    table = world.textures.tables[binding.table]
    point = point if binding.filtered else point.unfiltered
    return table.look_up(take(binding.nodes, row), point, coloured=binding.channel is None)


def _value_by_slot(world: World, maps: NodeMap, at: Interaction, *, coloured: bool) -> Tensor:
    """Return the values of textures that belong to primitives, not to BSDF parameters; arbitrary where there is no texture.

    ``coloured``: True: colours ``(3, n)``. False: numbers ``(n,)``.
    """
    node, point = take(maps.nodes, at.slot).clamp_min(0), TexturePoint(uv=surface_uv(world, at))
    first, *others = (world.textures.tables[number] for number in maps.tables)
    # maps.tables: indices in world.textures.tables; maps.table: which of these each slot reads.
    if maps.table is None:  # all nodes are rows of the first table
        return first.look_up(node, point, coloured=coloured)
    table_of_lane = take(maps.table, at.slot)
    # Each table looks up all lanes; those of other tables read its row 0, and the result is dropped.
    value = first.look_up(torch.where(table_of_lane == 0, node, 0), point, coloured=coloured)
    for k, table in enumerate(others, 1):
        in_table = table_of_lane == k
        value = torch.where(in_table, table.look_up(torch.where(in_table, node, 0), point, coloured=coloured), value)
    return value


def opacity_map(world: World, at: Interaction) -> Tensor:
    """Return the factor ``(N,)`` of opacity textures at surface points; 1 where there is no texture."""
    maps = world.textures.opacity
    assert maps is not None
    value = _value_by_slot(world, maps, at, coloured=False)
    value = torch.addcmul(take(maps.bias, at.slot), take(maps.factor, at.slot), value)
    if maps.cutoff is not None:
        cutoff = take(maps.cutoff, at.slot)  # -1 where the material has none
        value = torch.where(cutoff < 0, value, (value >= cutoff).to(value.dtype))
    return torch.where(take(maps.nodes, at.slot) < 0, 1.0, value)


def emission_map(world: World, at: Interaction) -> Tensor:
    """Return the factor ``(3, N)`` of emission textures at surface points; 1 where there is no texture."""
    maps = world.textures.emission
    assert maps is not None
    value = _value_by_slot(world, maps, at, coloured=True)
    return torch.where(take(maps.nodes, at.slot) < 0, 1.0, value)


def shading_normal(world: World, number: int, d: Tensor, at: Interaction, point: TexturePoint | None) -> Tensor:
    """Return the shading normal ``(3, N)`` on the shape's outside, normal and bump maps included.

    Args:
        world: the scene's tensors.
        number: index of the BSDF model that all points have.
        d: directions ``(3, N)`` of the incoming rays.
        at: the surface points.
        point: their texture coordinates, see :func:`texture_point_at`; needed if the model has a normal or bump map.
    """
    textures = world.materials.textures[number]
    if textures is None or (textures.normal is None and textures.bump is None):
        return at.ns
    assert point is not None
    row = take(world.materials.row, at.slot)
    side = None if world.materials.models[number].transmits else _side(d, at.ng)
    frame, _ = _perturbed_frame(world, textures, row, point, d, at, side)
    return frame.n if side is None else frame.n * side


def _perturbed_frame(
    world: World,
    textures: MaterialTextures,
    row: Tensor,
    point: TexturePoint,
    d: Tensor,
    at: Interaction,
    side: Tensor | None,
    mirrored: bool = False,
) -> tuple[Frame, PerturbedNormal]:
    """Return the shading frame of a normal or bump map, and the unperturbed normal; arguments as for :func:`perturb_normal`."""
    colour = None if textures.normal is None else _texture_values(world, textures.normal, row, point)
    slope = None
    if colour is None:
        assert textures.bump is not None
        table = world.textures.tables[textures.bump.table]
        point = point if textures.bump.filtered else point.unfiltered
        slope = table.slope(take(textures.bump.nodes, row), point)
    return perturb_normal(textures, row, colour, slope, d, at, side, mirrored)
