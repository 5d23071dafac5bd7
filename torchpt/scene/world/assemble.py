"""Build a :class:`~torchpt.physics.world.World` of parts and parameters: one differentiable function of the parameters.

:meth:`torchpt.scene.scene.Scene.world` calls :func:`assemble`. A *part* (:class:`~torchpt.physics.parts.Part`) is a set of
primitives of one kind with one material; a *copy* is an instance of a part. The world has P primitives, and I instances. What a
surface has of its own (material, opacity, object id) is stored by *slot*: one for each primitive, then one for each instance.
Features that the scene does not use have no tensors: smooth normals, lights, quadrics, textures and so on are None.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.vectors import side_by_side
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.physics.bsdfs.records import LaneMaterials
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.lights.base import Environment
from torchpt.physics.lights.records import Lights
from torchpt.physics.parts import Copy, Part, Source
from torchpt.physics.shapes.geometry import KINDS, Geometry, LaneGeometry
from torchpt.physics.shapes.primitive import Corners
from torchpt.physics.textures import MaterialTextures, Node, NodeMap, NodePosition, OpacityMaps, Table, build_tables
from torchpt.physics.textures.records import LaneTextures
from torchpt.physics.world import World
from torchpt.scene.space import MAX_COORDINATE, Space
from torchpt.scene.world.emitters import lights_of
from torchpt.scene.world.materials import (
    GroupKey,
    LaneMaterial,
    lane_material,
    members_of,
    node_map_of,
    opacity_maps_of,
    opacity_of,
    parameters_of_group,
    textures_of_group,
    vertex_attributes_of,
)
from torchpt.scene.world.pieces import ParameterReads, Pieced, passing_piece, piece
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
    alone: bool = False,
    own_models: Sequence[Bsdf] = (),
    on_geometry: Callable[[Geometry], None] | None = None,
) -> tuple[World, Geometry]:
    """Build the world that stages read, and the geometry that the search reads.

    Args:
        parts: the parts, ordered by kind as ``geometry.KINDS``.
        parameters: every tensor by dotted name. With :class:`~torchpt.scene.world.pieces.ParameterReads` pieces of earlier
            worlds are used again where their parameters are unchanged.
        sources: delta lights and environments, in the order of ``lights.sort_key``.
        space: the coordinates of lanes.
        dtype: dtype of the lanes.
        copies: instances of parts, in the order of their slots.
        uv: True for texture coordinates even where no texture reads them.
        choice: the light sampler, from ``lights.LIGHT_SAMPLERS``.
        alone: True where lights are sampled alone, not combined with BSDF sampling by MIS.
        own_models: the user's own BSDFs, whose results may depend on more than parameters.
        on_geometry: gets the geometry before the rest is built.

    Raises:
        SceneError: parameters with positions or sizes beyond the range of float32.
    """
    reads = parameters if isinstance(parameters, ParameterReads) else ParameterReads(parameters)
    assembly = _Assembly(parts, copies, sources, reads, space, dtype, uv=uv, own_models=own_models)
    # Of environments alone the light table depends on it: elsewhere both ways share their table.
    alone = alone or not any(issubclass(LIGHTS[source.kind], Environment) for source in sources)
    geometry = assembly.geometry()
    if on_geometry is not None:
        on_geometry(geometry)
    return assembly.world(choice, alone), geometry


class _Assembly(Pieced):
    """One assembly; arguments as for :func:`assemble`. Methods return pieces of the world."""

    def __init__(
        self,
        parts: Sequence[Part],
        copies: Sequence[Copy],
        sources: Sequence[Source],
        parameters: ParameterReads,
        space: Space,
        dtype: torch.dtype,
        *,
        uv: bool,
        own_models: Sequence[Bsdf],
    ) -> None:
        super().__init__(parameters)
        self.parts, self.copies, self.sources = parts, copies, sources
        self.space, self.dtype, self.device = space, dtype, space.centre.device
        self.uv, self.own_models = uv, own_models
        self.owners: list[Part | Copy] = [*parts, *copies]  # in the order of slots

    @cached_property
    def materials(self) -> dict[str, ResolvedMaterial]:
        """Return the materials by name."""
        return {owner.material.name: _with_scaled_bump(owner.material, self.space.unit) for owner in self.owners}

    # -- surfaces

    @passing_piece
    def corners(self) -> list[Corners]:
        """Return the corners of each part."""
        return corners_of_all(self.parts, self.parameters, self.space, self.dtype)

    @piece
    def primitives(self) -> Primitives:
        """Return the primitives."""
        primitives = primitives_of(self.parts, self.corners(), self.dtype, self.device)
        _check_reach(self.parts, primitives, self.space)
        return primitives

    @piece
    def copy_transforms(self) -> Tensor | None:
        """Return the transforms of copies, see :func:`copy_maps`; None without copies."""
        if not self.copies:
            return None
        return copy_maps(self.parts, self.primitives().sizes, self.copies, self.parameters, self.space)

    @piece
    def geometry(self) -> Geometry:
        """Return the geometry for the search."""
        return self.primitives().geometry(self.copy_transforms())

    @piece
    def lane_geometry(self) -> LaneGeometry:
        """Return the geometry for stages."""
        primitives, copy_transforms = self.primitives(), self.copy_transforms()
        models = [model for (model, _), _ in self.members()]
        attributes = vertex_attributes_of(
            self.parts, self.corners(), primitives.sizes, self.parameters, self.materials, models, uv=self.uv
        )
        return LaneGeometry(
            kinds=primitives.kinds,
            counts=primitives.counts,
            ends=torch.tensor(primitives.counts, dtype=torch.int64, device=self.device).cumsum(0),
            p0=side_by_side(primitives.p0),
            e1=primitives.e1,
            e2=primitives.e2,
            normal=primitives.normal,
            bound=primitives.bound,
            flip=primitives.sign if primitives.counts[KINDS.index("sphere")] else None,
            normals=primitives.normals,
            **attributes,
            object_id=primitives.spread([owner.object_id for owner in self.owners]),
            quadrics=primitives.quadrics,
            copies=None if copy_transforms is None else copies_of(copy_transforms, self.copies, self.dtype),
        )

    @piece
    def slot_counts(self) -> list[int]:
        """Return the number of slots of each owner."""
        with self.parameters.structure_only():
            return self.primitives().sizes + [1] * len(self.copies)

    # -- materials

    @piece
    def members(self) -> list[tuple[GroupKey, list[str]]]:
        """Return the groups of materials, see :func:`members_of`."""
        with self.parameters.structure_only():
            return list(members_of(self.materials, self.lane_materials()).items())

    @piece
    def lane_material(self, name: str) -> LaneMaterial:
        """Return a material on lanes."""
        return lane_material(self.materials[name], self.parameters, self.dtype, self.device)

    def lane_materials(self) -> dict[str, LaneMaterial]:
        """Return all materials on lanes by name."""
        return {name: self.lane_material(name) for name in self.materials}

    @piece
    def group_parameters(self, number: int) -> Parameters:
        """Return the stacked parameters of a group of materials."""
        (model, form), names = self.members()[number]
        if self.own_models:
            self.parameters.read_more()
        return parameters_of_group(model, form, [self.lane_material(name).values for name in names])

    @piece
    def group_textures(self, number: int) -> MaterialTextures | None:
        """Return the textures of a group of materials; None without."""
        (_, form), names = self.members()[number]
        if form is None:
            return None
        lane_materials = [self.lane_material(name) for name in names]
        _, positions = self.nodes()
        materials = [self.materials[name] for name in names]
        return textures_of_group(materials, lane_materials, positions, self.parameters, self.dtype, self.device)

    @piece
    def group_sides(self, number: int) -> Tensor | None:
        """Return which materials of a group are two-sided ``(rows,)`` bool; None where all are."""
        _, names = self.members()[number]
        flags = [self.materials[name].two_sided for name in names]
        return None if all(flags) else torch.tensor(flags, device=self.device)

    @piece
    def opacity(self) -> Tensor | None:
        """Return the opacity by slot, see :func:`opacity_of`."""
        with self.parameters.structure_only():
            materials = self.lane_materials()
        # Of these alone values are read.
        materials |= {name: self.lane_material(name) for name in materials if materials[name].opacity is not None}
        return opacity_of(self.owners, materials, self.slot_counts(), self.dtype, self.device)

    @passing_piece
    def dark(self) -> Tensor:
        """Return ``(P + I,)`` 0 where a surface emits, else 1; instances cannot emit."""
        emits = [int(part.emission is None) for part in self.parts]
        with self.parameters.structure_only():
            return self.primitives().spread(emits + [1] * len(self.copies))

    @piece
    def rows_and_keys(self) -> tuple[Tensor, Tensor]:
        """Return ``row`` and ``key`` of :class:`LaneMaterials`."""
        groups = [names for _, names in self.members()]
        places = {name: (number, row) for number, names in enumerate(groups) for row, name in enumerate(names)}
        with self.parameters.structure_only():
            return _rows_and_keys(self.owners, places, len(groups), self.primitives(), self.dark())

    def lane_materials_of_slots(self) -> LaneMaterials:
        """Return the materials of all slots."""
        models = tuple(model for (model, _), _ in self.members())
        groups = range(len(models))
        row, key = self.rows_and_keys()
        return LaneMaterials(
            row=row,
            key=key,
            models=models,
            parameters=tuple(self.group_parameters(number) for number in groups),
            textures=tuple(self.group_textures(number) for number in groups),
            two_sided=tuple(self.group_sides(number) for number in groups),
            opacity=self.opacity(),
        )

    # -- textures

    @piece
    def nodes(self) -> tuple[tuple[Table, ...], dict[Node, NodePosition]]:
        """Return the tables of all uses of textures, and the position of each."""
        uses = [node for material in self.materials.values() for node in material.textures()]
        return build_tables(uses, self.parameters, self.dtype, self.device)

    @piece
    def opacity_maps(self) -> OpacityMaps | None:
        """Return the textures of opacity by slot, see :func:`opacity_maps_of`."""
        with self.parameters.structure_only():
            _, positions = self.nodes()
            materials, counts = self.lane_materials(), self.slot_counts()
            return opacity_maps_of(self.owners, materials, positions, counts, self.dtype, self.device)

    @piece
    def emission_maps(self) -> NodeMap | None:
        """Return the textures of emission by slot; instances cannot emit."""
        with self.parameters.structure_only():
            _, positions = self.nodes()
            textures = [part.emission_texture for part in self.parts] + [None] * len(self.copies)
            return node_map_of(textures, positions, self.slot_counts(), self.device)

    @piece
    def textures(self) -> LaneTextures:
        """Return the textures."""
        tables, _ = self.nodes()
        return LaneTextures(tables=tables, opacity=self.opacity_maps(), emission=self.emission_maps())

    # -- lights, and all together

    @piece
    def lights(self, choice: str, alone: bool) -> Lights | None:
        """Return the light table; None where nothing emits. Arguments as for :func:`assemble`."""
        with self.parameters.structure_only():
            materials = self.lane_materials()
        opacity_mapped = any(
            part.emission is not None and materials[part.material.name].opacity_texture for part in self.parts
        )
        return lights_of(
            self.parts,
            self.sources,
            _emitter_primitives(self.parts, self.primitives()),
            self.geometry(),
            self.parameters,
            self.space,
            self.opacity(),
            emissive=self.dark() == 0,
            opacity_mapped=opacity_mapped,
            choice=choice,
            alone=alone,
        )

    @piece
    def world(self, choice: str, alone: bool) -> World:
        """Return the world; arguments as for :func:`assemble`."""
        return World(
            geometry=self.lane_geometry(),
            materials=self.lane_materials_of_slots(),
            textures=self.textures(),
            lights=self.lights(choice, alone),
        )


def _emitter_primitives(parts: Sequence[Part], primitives: Primitives) -> Primitives:
    """Return the primitives for the light table, detached where no emissive part requires gradients.

    Rows of the light table are slices of the tensors of all primitives. If any part requires gradients, so do those tensors,
    and the light table would be differentiated without need.
    """
    emissive = (taped for part, taped in zip(parts, primitives.taped, strict=True) if part.emission is not None)
    return primitives if any(emissive) else primitives.detached()


def _rows_and_keys(
    owners: Sequence[Part | Copy],
    places: Mapping[str, tuple[int, int]],
    count: int,
    primitives: Primitives,
    dark: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the row of the material of each slot ``(P + I,)``, and the keys ``(P + I + 1,)`` that lanes are sorted by.

    The order is: emissive surfaces by group of materials, then other surfaces by group, then rays without a hit.
    ``key[slot + 1]`` is that of a slot, so that the slot -1 of a ray without a hit finds ``key[0]``.

    Args:
        owners: parts and copies, in the order of slots.
        places: group of each material and row in it, by name.
        count: number of groups.
        primitives: of the parts.
        dark: ``(P + I,)`` 0 where a surface emits, else 1.
    """
    group, row = zip(*(places[owner.material.name] for owner in owners), strict=True) if owners else ((), ())
    keys = dark * count + primitives.spread(group)
    missed = torch.full((1,), 2 * count, device=keys.device)  # the key of a ray without a hit
    return primitives.spread(row), torch.cat((missed, keys)).to(torch.uint8)


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
