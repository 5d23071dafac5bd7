"""From parts and parameters to a :class:`~torchpt.physics.world.World`: one differentiable function of the parameters.

Whatever the scene does not hold is left out here: no smooth normals, no lights, no spheres, no second BSDF, then no tensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.core.tree import leaves
from torchpt.physics.bsdfs.records import LaneMaterials
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Copy, Part, Source
from torchpt.physics.shapes.geometry import Geometry, LaneGeometry
from torchpt.physics.shapes.primitive import Corners
from torchpt.physics.textures import tables_of
from torchpt.physics.textures.records import LaneTextures
from torchpt.physics.world import World
from torchpt.scene.space import MAX_COORDINATE, Space
from torchpt.scene.world.emitters import lights_of
from torchpt.scene.world.materials import (
    Groups,
    groups_of,
    lane_material,
    node_map_of,
    opacity_maps_of,
    opacity_of,
    vertex_attributes_of,
)
from torchpt.scene.world.primitives import Primitives, copies_of, copy_maps, corners_of_all, primitives_of

__all__ = ["assemble"]


def assemble(
    parts: Sequence[Part],
    parameters: Mapping[str, Tensor],
    sources: Sequence[Source],
    space: Space,
    dtype: torch.dtype,
    copies: Sequence[Copy] = (),
    uv: bool = False,
    choice: str = "auto",
) -> tuple[World, Geometry]:
    """The world of ``parts`` under ``parameters``, and what the search sees of it.

    Args:
        parts: ordered by kind as ``records.KINDS``.
        parameters: every tensor by dotted name.
        sources: lights that are no surfaces, ordered as ``lights.sort_key`` says.
        space: the lanes' coordinates.
        dtype: of the lanes.
        copies: instances of parts.
        uv: whether texture coordinates are wanted even if no texture reads them.
        choice: how a light is chosen, from ``lights.LIGHT_SAMPLERS``.

    Raises:
        SceneError: parameters that put something further away than float32 can follow.
    """
    device = space.centre.device
    corners = corners_of_all(parts, parameters, space, dtype)
    primitives = primitives_of(parts, corners, dtype, device)
    _check_reach(parts, primitives, space)
    owners: list[Part | Copy] = [*parts, *copies]
    materials = {owner.material.name: _with_scaled_bump(owner.material, space.unit) for owner in owners}
    made = {name: lane_material(material, parameters, dtype) for name, material in materials.items()}
    nodes = [node for material in materials.values() for node in material.readings()]
    tables, places = tables_of(nodes, parameters, dtype, device)
    groups = groups_of(materials, made, places, parameters, dtype, device)
    wide = primitives.sizes + [1] * len(copies)
    opacity = opacity_of(owners, made, wide, dtype, device)
    dark = primitives.spread([int(part.emission is None) for part in parts] + [1] * len(copies))
    emission_textures = [part.emission_texture for part in parts] + [None] * len(copies)
    maps = copy_maps(parts, primitives.sizes, copies, parameters, space) if copies else None
    geometry = primitives.geometry(maps)
    opacity_mapped = any(part.emission is not None and made[part.material.name].opacity_texture for part in parts)
    lights = lights_of(
        parts,
        sources,
        _emitter_primitives(parts, corners, primitives),
        geometry,
        parameters,
        space,
        opacity,
        dark == 0,
        opacity_mapped,
        choice,
    )
    world = World(
        geometry=LaneGeometry(
            kinds=primitives.kinds,
            counts=primitives.counts,
            ends=torch.tensor(primitives.counts, dtype=torch.int64, device=device).cumsum(0),
            p0=primitives.p0,
            e1=primitives.e1,
            e2=primitives.e2,
            normal=primitives.normal,
            bound=primitives.bound,
            flip=primitives.sign if primitives.counts[3] else None,
            normals=primitives.normals,
            **vertex_attributes_of(parts, corners, primitives.sizes, parameters, materials, groups.models, uv),
            object_id=primitives.spread([owner.object_id for owner in owners]),
            quadrics=primitives.quadrics,
            copies=None if maps is None else copies_of(maps, copies, dtype),
        ),
        materials=_materials(owners, primitives, groups, dark, opacity),
        textures=LaneTextures(
            tables=tables,
            opacity=opacity_maps_of(owners, made, places, wide, dtype, device),
            emission=node_map_of(emission_textures, places, wide, device),
        ),
        lights=lights,
    )
    return world, geometry


def _emitter_primitives(parts: Sequence[Part], corners: Sequence[Corners], primitives: Primitives) -> Primitives:
    """The primitives, without derivatives where no part that emits has any: what is cut out of the whole would seem to."""
    moving = any(
        part.emission is not None and any(x.requires_grad for x in leaves(own))
        for part, own in zip(parts, corners, strict=True)
    )
    return primitives if moving else primitives.detached()


def _materials(
    owners: Sequence[Part | Copy], primitives: Primitives, groups: Groups, dark: Tensor, opacity: Tensor | None
) -> LaneMaterials:
    """Who is made of what; ``dark``: ``(P + I,)`` 0 where a surface emits, else 1."""
    count = len(groups.models)
    group, row = zip(*(groups.place[owner.material.name] for owner in owners), strict=True) if owners else ((), ())
    keys = dark * count + primitives.spread(group)
    missed = torch.full((1,), 2 * count, device=keys.device)
    return LaneMaterials(
        row=primitives.spread(row),
        key=torch.cat((missed, keys)).to(torch.uint8),
        models=groups.models,
        parameters=groups.parameters,
        textures=groups.textures,
        two_sided=groups.two_sided,
        opacity=opacity,
    )


def _with_scaled_bump(material: ResolvedMaterial, unit: float) -> ResolvedMaterial:
    """A material where lengths are counted in ``unit``: the heights of a bump map are lengths."""
    if unit == 1.0 or material.bump_map is None:
        return material
    return replace(material, bump_map=material.bump_map.divided(unit))


def _check_reach(parts: Sequence[Part], primitives: Primitives, space: Space) -> None:
    """Refuse parameters that make a part too large, or lay it too far off."""
    reach = torch.stack([x.detach().abs().amax(0) for x in (primitives.p0, primitives.e1, primitives.e2)]).amax(0)
    if len(reach) and not bool(reach.max() <= MAX_COORDINATE):
        farthest = int(torch.nan_to_num(reach, nan=torch.inf).argmax())
        part = parts[int(primitives.spread(range(len(parts)))[farthest])]
        expected = (
            f"places and sizes up to {MAX_COORDINATE * space.unit:.3g} from the middle of this scene as it was loaded"
        )
        raise SceneError(f"params.{part.name}", float(reach[farthest]) * space.unit, expected)
