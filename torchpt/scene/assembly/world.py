"""From parts and parameters to a :class:`~torchpt.records.World`: one differentiable function of the parameters.

Whatever the scene does not hold is left out here: no smooth normals, no lights, no spheres, no second BSDF, then no tensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchpt.errors import SceneError
from torchpt.records import Geometry, World
from torchpt.scene.assembly.charts import charts_of
from torchpt.scene.assembly.copies import copies_of, copy_maps
from torchpt.scene.assembly.corners import corners_of
from torchpt.scene.assembly.emitters import lights_of
from torchpt.scene.assembly.materials import materials_of, nodes_of, opacity_of, veils_of
from torchpt.scene.assembly.primitives import Primitives, primitives_of
from torchpt.scene.parts import Copy, MaterialSlot, Part, Source
from torchpt.scene.space import FARTHEST, Space
from torchpt.scene.surfaces import surface_of
from torchpt.scene.texels import images_of
from torchpt.textures import atlas_of

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
        sources: lights that are no surfaces, ordered by kind as ``records.SOURCES``.
        space: the lanes' coordinates.
        dtype: of the lanes.
        copies: instances of parts.
        uv: whether texture coordinates are wanted even if no texture reads them.
        choice: how a light is chosen, from ``lights.WAYS``.

    Raises:
        SceneError: parameters that put something further away than float32 can follow.
    """
    device = space.centre.device
    corners = [corners_of(part, parameters, space, dtype) for part in parts]
    primitives = primitives_of(parts, corners, dtype, device)
    _check_reach(parts, primitives, space)
    owners: list[Part | Copy] = [*parts, *copies]
    slots = {owner.material.name: _in_units(owner.material, space.unit) for owner in owners}
    surfaces = {name: surface_of(slot, parameters, dtype) for name, slot in slots.items()}
    nodes = nodes_of(slots.values())
    kinds, rows, tables, looks, two_sided = materials_of(slots, surfaces, nodes, parameters, dtype, device)
    models = tuple(model for model, _ in kinds)
    wide = primitives.sizes + [1] * len(copies)
    opacity = opacity_of(owners, surfaces, wide, dtype, device)
    dark = primitives.spread([int(part.emission is None) for part in parts] + [1] * len(copies))
    keys = dark * len(models) + primitives.spread([rows[owner.material.name][0] for owner in owners])
    key = torch.cat((torch.full((1,), 2 * len(models), device=device), keys)).to(torch.uint8)
    veiled = any(part.emission is not None and surfaces[part.material.name].cover for part in parts)
    glows = None
    if any(part.glow is not None for part in parts):
        glowing = [-1 if part.glow is None else nodes[part.glow] for part in parts]
        glows = primitives.spread(glowing + [-1] * len(copies))
    maps = copy_maps(parts, primitives.sizes, copies, parameters, space) if copies else None
    geometry = primitives.geometry(maps)
    world = World(
        counts=primitives.counts,
        ends=torch.tensor(primitives.counts, dtype=torch.int64, device=device).cumsum(0),
        p0=primitives.p0,
        e1=primitives.e1,
        e2=primitives.e2,
        normal=primitives.normal,
        bound=primitives.bound,
        flip=primitives.sign if primitives.counts[3] else None,
        normals=primitives.normals,
        **charts_of(parts, corners, primitives.sizes, parameters, slots, models, uv),
        opacity=opacity,
        material=primitives.spread([rows[owner.material.name][1] for owner in owners]),
        key=key,
        models=models,
        bsdfs=tables,
        looks=looks,
        textures=atlas_of(list(nodes), images_of(list(nodes), parameters), dtype, device) if nodes else None,
        veils=veils_of(owners, surfaces, nodes, wide, dtype, device),
        glows=glows,
        two_sided=two_sided,
        object_id=primitives.spread([owner.object_id for owner in owners]),
        lights=lights_of(parts, sources, primitives, geometry, parameters, space, opacity, dark == 0, veiled, choice),
        quadrics=primitives.quadrics,
        copies=None if maps is None else copies_of(maps, copies, dtype),
    )
    return world, geometry


def _in_units(slot: MaterialSlot, unit: float) -> MaterialSlot:
    """A material where lengths are counted in ``unit``: the heights of a bump map are lengths."""
    if unit == 1.0 or slot.bump_map is None:
        return slot
    x, y, z = slot.bump_map.scale
    return replace(slot, bump_map=replace(slot.bump_map, scale=(x / unit, y / unit, z / unit)))


def _check_reach(parts: Sequence[Part], primitives: Primitives, space: Space) -> None:
    """Refuse parameters that make a part too large, or lay it too far off."""
    reach = torch.stack([x.detach().abs().amax(0) for x in (primitives.p0, primitives.e1, primitives.e2)]).amax(0)
    if len(reach) and not bool(reach.max() <= FARTHEST):
        farthest = int(torch.nan_to_num(reach, nan=torch.inf).argmax())
        part = parts[int(primitives.spread(range(len(parts)))[farthest])]
        expected = f"places and sizes up to {FARTHEST * space.unit:.3g} from the middle of this scene as it was loaded"
        raise SceneError(f"params.{part.name}", float(reach[farthest]) * space.unit, expected)
