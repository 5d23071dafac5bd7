"""Build a :class:`~torchpt.physics.world.World` of parts and parameters: one differentiable function of the parameters.

:meth:`torchpt.scene.scene.Scene.world` calls :func:`assemble`. A *part* (:class:`~torchpt.physics.parts.Part`) is a set of
primitives of one kind with one material; a *copy* is an instance of a part. The world has P primitives, and I instances. What a
surface has of its own (material, opacity, object id) is stored by *slot*: one for each primitive, then one for each instance.
Features that the scene does not use have no tensors: smooth normals, lights, quadrics, textures and so on are None.
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
from torchpt.physics.shapes.geometry import KINDS, Geometry, LaneGeometry
from torchpt.physics.shapes.primitive import Corners
from torchpt.physics.textures import build_tables
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
    """Build the world that stages read, and the geometry that the search reads.

    Args:
        parts: the parts, ordered by kind as ``geometry.KINDS``.
        parameters: every tensor by dotted name.
        sources: delta lights and environments, in the order of ``lights.sort_key``.
        space: the coordinates of lanes.
        dtype: dtype of the lanes.
        copies: instances of parts, in the order of their slots.
        uv: True for texture coordinates even where no texture reads them.
        choice: the light sampler, from ``lights.LIGHT_SAMPLERS``.

    Raises:
        SceneError: parameters with positions or sizes beyond the range of float32.
    """
    device = space.centre.device
    corners = corners_of_all(parts, parameters, space, dtype)
    primitives = primitives_of(parts, corners, dtype, device)
    _check_reach(parts, primitives, space)
    owners: list[Part | Copy] = [*parts, *copies]  # in the order of slots
    slot_counts = primitives.sizes + [1] * len(copies)  # number of slots of each owner
    materials = {owner.material.name: _with_scaled_bump(owner.material, space.unit) for owner in owners}
    lane_materials = {name: lane_material(material, parameters, dtype) for name, material in materials.items()}
    nodes = [node for material in materials.values() for node in material.textures()]  # uses of textures
    tables, node_positions = build_tables(nodes, parameters, dtype, device)
    groups = groups_of(materials, lane_materials, node_positions, parameters, dtype, device)
    opacity = opacity_of(owners, lane_materials, slot_counts, dtype, device)
    # (P + I,) 0 where a surface emits, else 1; instances cannot emit.
    dark = primitives.spread([int(part.emission is None) for part in parts] + [1] * len(copies))
    emission_textures = [part.emission_texture for part in parts] + [None] * len(copies)
    copy_transforms = copy_maps(parts, primitives.sizes, copies, parameters, space) if copies else None
    geometry = primitives.geometry(copy_transforms)
    opacity_mapped = any(
        part.emission is not None and lane_materials[part.material.name].opacity_texture for part in parts
    )
    lights = lights_of(
        parts,
        sources,
        _emitter_primitives(parts, corners, primitives),
        geometry,
        parameters,
        space,
        opacity,
        emissive=dark == 0,
        opacity_mapped=opacity_mapped,
        choice=choice,
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
            flip=primitives.sign if primitives.counts[KINDS.index("sphere")] else None,
            normals=primitives.normals,
            **vertex_attributes_of(parts, corners, primitives.sizes, parameters, materials, groups.models, uv=uv),
            object_id=primitives.spread([owner.object_id for owner in owners]),
            quadrics=primitives.quadrics,
            copies=None if copy_transforms is None else copies_of(copy_transforms, copies, dtype),
        ),
        materials=_materials(owners, primitives, groups, dark, opacity),
        textures=LaneTextures(
            tables=tables,
            opacity=opacity_maps_of(owners, lane_materials, node_positions, slot_counts, dtype, device),
            emission=node_map_of(emission_textures, node_positions, slot_counts, device),
        ),
        lights=lights,
    )
    return world, geometry


def _emitter_primitives(parts: Sequence[Part], corners: Sequence[Corners], primitives: Primitives) -> Primitives:
    """Return the primitives for the light table, detached where no emissive part requires gradients.

    Rows of the light table are slices of the tensors of all primitives. If any part requires gradients, so do those tensors,
    and the light table would be differentiated without need.
    """
    moving = any(
        part.emission is not None and any(tensor.requires_grad for tensor in leaves(own_corners))
        for part, own_corners in zip(parts, corners, strict=True)
    )
    return primitives if moving else primitives.detached()


def _materials(
    owners: Sequence[Part | Copy], primitives: Primitives, groups: Groups, dark: Tensor, opacity: Tensor | None
) -> LaneMaterials:
    """Return the materials of all slots; ``dark``: ``(P + I,)`` 0 where a surface emits, else 1.

    Lanes are sorted by ``key``: emissive surfaces by group of materials, then other surfaces by group, then rays without a hit.
    ``key[slot + 1]`` is that of a slot, so that the slot -1 of a ray without a hit finds ``key[0]``.
    """
    count = len(groups.models)
    group, row = (
        zip(*(groups.group_and_row[owner.material.name] for owner in owners), strict=True) if owners else ((), ())
    )
    keys = dark * count + primitives.spread(group)
    missed = torch.full((1,), 2 * count, device=keys.device)  # the key of a ray without a hit
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
    """Return a material with the heights of its bump map, which are lengths, divided by ``unit``."""
    if unit == 1.0 or material.bump_map is None:
        return material
    return replace(material, bump_map=material.bump_map.divided(unit))


def _check_reach(parts: Sequence[Part], primitives: Primitives, space: Space) -> None:
    """Raise for parameters that make a part too large or move it too far from the origin."""
    # (P,) largest coordinate or extent of each primitive, in world units
    reach = torch.stack([x.detach().abs().amax(0) for x in (primitives.p0, primitives.e1, primitives.e2)]).amax(0)
    if len(reach) and not bool(reach.max() <= MAX_COORDINATE):  # True for NaN too
        farthest = int(torch.nan_to_num(reach, nan=torch.inf).argmax())
        part = parts[int(primitives.spread(range(len(parts)))[farthest])]
        expected = (
            f"places and sizes up to {MAX_COORDINATE * space.unit:.3g} from the middle of this scene as it was loaded"
        )
        raise SceneError(f"params.{part.name}", float(reach[farthest]) * space.unit, expected)
