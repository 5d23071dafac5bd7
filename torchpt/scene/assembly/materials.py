"""Materials: grouped by model and by what textures give; opacity by primitive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import KINDS, Bsdf, Parameters, stacked
from torchpt.bsdfs.resolved import ResolvedMaterial
from torchpt.errors import SceneError
from torchpt.scene.assembly.lane_material import LaneMaterial
from torchpt.scene.parts import Copy, Part
from torchpt.textures import MaterialTextures, Node, NodeMap, OpacityMaps, Place, TextureBinding

__all__ = ["MOST_MODELS", "Groups", "groups_of", "node_map_of", "opacity_maps_of", "opacity_of"]


#: Lanes are sorted by keys of 8 bits, two for each model.
MOST_MODELS = 120


#: What the lanes of a group have in common: a model, and which of its parameters are read from what.
Kind = tuple[Bsdf, Any]


@dataclass(frozen=True)
class Groups:
    """Materials grouped by model and by what textures give.

    Attributes:
        place: group and row of each material, by name.
        models: of each group.
        parameters: of each group, stacked.
        textures: of each group; None where it reads none.
        two_sided: of each group ``(rows,)`` bool; None where all are.
    """

    place: dict[str, tuple[int, int]]
    models: tuple[Bsdf, ...]
    parameters: tuple[Parameters, ...]
    textures: tuple[MaterialTextures | None, ...]
    two_sided: tuple[Tensor | None, ...]


def groups_of(
    materials: Mapping[str, ResolvedMaterial],
    made: Mapping[str, LaneMaterial],
    places: Mapping[Node, Place],
    parameters: Mapping[str, Tensor],
    dtype: torch.dtype,
    device: torch.device,
) -> Groups:
    """The groups of materials, by name as resolved and as ``made`` for the lanes.

    Raises:
        SceneError: more groups than lanes can be sorted by.
    """
    members: dict[Kind, list[str]] = {}
    for name, material in made.items():
        members.setdefault(_kind(materials[name], material), []).append(name)
    if not members:
        members[KINDS["diffuse"](), None] = []
    if len(members) > MOST_MODELS:
        expected = f"at most {MOST_MODELS} models, blends and textured ones counted by what they are made of"
        raise SceneError("materials", len(members), expected)
    place, stacks, textures, sides = {}, [], [], []
    for number, ((model, form), names) in enumerate(members.items()):
        place |= {name: (number, row) for row, name in enumerate(names)}
        if form is None:
            stacks.append(stacked([model.prepare(made[name].values) for name in names], model.factors))
            textures.append(None)
        else:
            stacks.append(stacked([_tabulated(model, made[name].values) for name in names], model.factors))
            read = _textures([materials[name] for name in names], [made[name] for name in names], places, device)
            strong = [f"{name}.normal_strength" for name in names]
            if any(name in parameters for name in strong):
                one = torch.ones((), dtype=dtype, device=device)
                strengths = [parameters[name].to(one) if name in parameters else one for name in strong]
                read = replace(read, strength=torch.stack(strengths))
            textures.append(read)
        both = [materials[name].two_sided for name in names]
        sides.append(None if all(both) else torch.tensor(both, device=device))
    return Groups(place, tuple(model for model, _ in members), tuple(stacks), tuple(textures), tuple(sides))


def _tabulated(model: Bsdf, values: Parameters) -> Parameters:
    """Values with what the model tabulates of them."""

    def merged(a: Parameters, b: Parameters) -> Parameters:
        inner = {key: merged(a[key], value) for key, value in b.items() if isinstance(value, dict)}
        return {**a, **b, **inner}

    return merged(values, model.tabulate(values))


def _kind(material: ResolvedMaterial, made: LaneMaterial) -> Kind:
    """The group of a material; materials without textures share that of their model."""
    if not made.readings and material.normal_map is None and material.bump_map is None:
        return made.model, None

    def form(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple(sorted((key, form(item)) for key, item in value.items()))
        return value.form if isinstance(value, Node) else "number"

    maps = form(material.normal_map), form(material.bump_map)
    return made.model, (form(made.values), form(made.readings), maps)


def _textures(
    materials: Sequence[ResolvedMaterial],
    made: Sequence[LaneMaterial],
    places: Mapping[Node, Place],
    device: torch.device,
) -> MaterialTextures:
    """The textures of materials of one form."""

    def binding(column: Sequence[Node]) -> TextureBinding:
        rows = torch.tensor([places[node].row for node in column], device=device)
        table, first = places[column[0]].table, column[0]
        return TextureBinding(table, rows, first.channel, any(node.filtered for node in column))

    def relief(column: list[Node | None]) -> TextureBinding | None:
        nodes = [node for node in column if node is not None]
        return binding(nodes) if nodes else None

    def bound(column: list[Any]) -> Any:
        first = column[0]
        if isinstance(first, dict):
            return {key: bound([item[key] for item in column]) for key in first}
        return binding(column)

    every = [node for material in materials for node in material.readings()]
    readings = bound([one.readings for one in made])
    return MaterialTextures(
        readings,
        relief([material.normal_map for material in materials]),
        relief([material.bump_map for material in materials]),
        filtered=any(node.filtered for node in every),
        reads=tuple(sorted({node.reads for node in every})),
    )


def node_map_of(
    nodes: Sequence[Node | None], places: Mapping[Node, Place], sizes: list[int], device: torch.device
) -> NodeMap | None:
    """Textures by primitive, from those of parts of ``sizes``; None where there are none."""
    if all(node is None for node in nodes):
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)
    tables = tuple(sorted({places[node].table for node in nodes if node is not None}))

    def spread(values: list[int]) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, device=device), size)

    rows = spread([-1 if node is None else places[node].row for node in nodes])
    if len(tables) == 1:
        return NodeMap(rows, tables, None)
    return NodeMap(rows, tables, spread([0 if node is None else tables.index(places[node].table) for node in nodes]))


def opacity_maps_of(
    parts: Sequence[Part | Copy],
    made: Mapping[str, LaneMaterial],
    places: Mapping[Node, Place],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> OpacityMaps | None:
    """Textures of opacity by primitive; None where there are none."""
    textures = [made[part.material.name].opacity_texture for part in parts]
    maps = node_map_of([None if texture is None else texture.node for texture in textures], places, sizes, device)
    if maps is None:
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)

    def spread(values: list[Any], kind: torch.dtype) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, dtype=kind, device=device), size)

    cutoffs = [
        -1.0 if texture is None or part.material.alpha_cutoff is None else part.material.alpha_cutoff
        for texture, part in zip(textures, parts, strict=True)
    ]
    return OpacityMaps(
        maps.nodes,
        maps.tables,
        maps.table,
        spread([0.0 if texture is None else texture.bias for texture in textures], dtype),
        spread([1.0 if texture is None else texture.factor for texture in textures], dtype),
        spread(cutoffs, dtype) if any(cutoff >= 0 for cutoff in cutoffs) else None,
    )


def opacity_of(
    parts: Sequence[Part | Copy],
    made: Mapping[str, LaneMaterial],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor | None:
    """The chance ``(P,)`` that a ray meets a primitive; None where it always does."""
    if all(one.opacity is None and one.opacity_texture is None for one in made.values()):
        return None
    whole = torch.ones(1, dtype=dtype, device=device)
    found = [made[part.material.name].opacity for part in parts]
    return torch.cat([(whole if x is None else x).expand(n) for x, n in zip(found, sizes, strict=True)])
