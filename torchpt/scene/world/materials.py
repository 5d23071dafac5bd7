"""Materials of the world: their values as lanes gather them, texture charts, rows by slot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.physics.bsdfs import KINDS, Bsdf, Parameters, stacked
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.primitive import PRIMITIVES, Corners
from torchpt.physics.textures import MaterialTextures, Node, NodeMap, NodePosition, OpacityMaps, TextureBinding

__all__ = [
    "MOST_MODELS",
    "Groups",
    "LaneMaterial",
    "OpacityTexture",
    "groups_of",
    "lane_material",
    "node_map_of",
    "opacity_maps_of",
    "opacity_of",
    "vertex_attributes_of",
]


# ---- Where a point lies on its surface: texture coordinates, tangents, vertex colours; each only where something reads it


def vertex_attributes_of(
    parts: Sequence[Part],
    corners: Sequence[Corners],
    sizes: list[int],
    parameters: Mapping[str, Tensor],
    materials: Mapping[str, ResolvedMaterial],
    models: Sequence[Bsdf],
    uv: bool,
) -> dict[str, Any]:
    """What of :class:`World` says where a point lies on its surface, each thing only where something reads it."""
    readings = [reading for material in materials.values() for reading in material.readings()]
    # Filtered look-ups ask how large a surface's texels are.
    bumpy = any(material.bump_map is not None for material in materials.values())
    bumpy = bumpy or any(reading.filtered for reading in readings)
    framed = (
        bumpy
        or any(material.normal_map is not None for material in materials.values())
        or any(m.anisotropic for m in models)
    )
    imaged = uv or any(reading.reads == "uv" for reading in readings)
    coloured = any(reading.reads == "colors" for reading in readings)
    pairs = list(zip(parts, corners, strict=True))
    kinds = [PRIMITIVES[part.kind] for part in parts]
    uvs = [kind.uvs(part, c) for kind, (part, c) in zip(kinds, pairs, strict=True)] if imaged or framed else []
    found: dict[str, Any] = dict.fromkeys(("tangents", "bitangents", "uvs", "axes", "mirrored", "colors"))
    if framed:
        moves = [
            kind.moves(part, c, corner, parameters[f"{part.name}.to_world"][:3, :3])
            for kind, (part, c), corner in zip(kinds, pairs, uvs, strict=True)
        ]
        found["tangents"] = torch.cat([move[0] for move in moves], 1)
        found["bitangents"] = torch.cat([move[1] for move in moves], 1) if bumpy else None
    if imaged:
        found["uvs"] = tuple(torch.cat([corner[k] for corner in uvs], 1) for k in range(3))
        balls = [parameters[f"{part.name}.to_world"] for part in parts if part.kind == "sphere"]
        if balls:
            from torchpt.physics.shapes.primitives.sphere import axes

            found["axes"] = axes(balls, corners[0].p0.dtype)
    if (imaged or bumpy) and any(c.mirrored and part.kind == "disk" for part, c in pairs):
        flags = torch.tensor([c.mirrored for c in corners], device=corners[0].p0.device)
        found["mirrored"] = torch.repeat_interleave(flags, torch.tensor(sizes, device=flags.device))
    if coloured:
        colors = [_colors(part, c) for part, c in pairs]
        found["colors"] = tuple(torch.cat([triple[k] for triple in colors], 1) for k in range(3))
    return found


def _colors(part: Part, c: Corners) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``(3, P)`` at the corners; 1 where a shape has none."""
    if part.colors is None:
        white = torch.ones_like(c.p0)
        return white, white, white
    assert c.faces is not None
    colors = torch.from_numpy(part.colors).to(c.p0).T
    first, second, third = (colors.index_select(1, c.faces[:, k]) for k in range(3))
    return first, second, third


# ---- What materials come to on the lanes: a model, its parameters, and the chance that a ray meets the surface
#
# Differentiable in the parameters, and done once a material. A blend with ``null`` is its other half, met more rarely.


@dataclass(frozen=True)
class OpacityTexture:
    """A texture of opacity: ``bias + factor * value`` is a factor of the chance that a ray meets the surface."""

    node: Node
    bias: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True)
class LaneMaterial:
    """A material on the lanes.

    Attributes:
        model: in the variant it needs.
        values: what the model is given, ``(3, 1)`` or ``(1,)``; of a blend nested. Without those that textures give.
        readings: the textures, nested alike.
        opacity: ``(1,)``, or None where it is 1.
        opacity_texture: the texture that opacity is multiplied by, or None.
    """

    model: Bsdf
    values: Parameters
    opacity: Tensor | None
    readings: dict[str, Any] = field(default_factory=dict)
    opacity_texture: OpacityTexture | None = None


def lane_material(material: ResolvedMaterial, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> LaneMaterial:
    """Resolve a material under ``parameters`` (every tensor by dotted name)."""
    readings = {key: value for key, value in material.values.items() if isinstance(value, Node)}
    values: Parameters = {
        key: parameters[f"{material.name}.{key}"].to(dtype)[..., None] for key in material.values if key not in readings
    }
    if material.inner:
        a, b = (lane_material(inner, parameters, dtype) for inner in material.inner)
        found = _blended(type(material.model), values.get("weight"), readings.get("weight"), a, b)
    else:
        device = next(iter(parameters.values())).device
        nothing = torch.zeros(1, dtype=dtype, device=device) if material.model.sheer else None
        found = LaneMaterial(material.model, values, nothing, readings)
    opacity, opacity_texture = found.opacity, found.opacity_texture
    if isinstance(material.opacity, Node):
        opacity_texture = OpacityTexture(material.opacity)
    elif material.opacity != 1.0:  # a number
        own = parameters[f"{material.name}.opacity"].to(dtype)[None]
        opacity = own if opacity is None else opacity * own
    if opacity is not None and material.alpha_cutoff is not None and opacity_texture is None:
        opacity = (opacity >= material.alpha_cutoff).to(dtype)
    return LaneMaterial(found.model, found.values, opacity, found.readings, opacity_texture)


def _blended(
    kind: Callable[[Bsdf, Bsdf], Bsdf], weight: Tensor | None, reading: Node | None, a: LaneMaterial, b: LaneMaterial
) -> LaneMaterial:
    """The blend of two materials, ``weight (1,)`` of the second: what is met of each, and how often either is."""
    opacity = None
    if weight is None:  # a texture, beside which nothing but null lets rays pass
        assert reading is not None
        if a.model.sheer:
            return LaneMaterial(b.model, b.values, None, b.readings, OpacityTexture(reading))
        if b.model.sheer:
            return LaneMaterial(a.model, a.values, None, a.readings, OpacityTexture(reading, 1.0, -1.0))
    elif a.opacity is not None or b.opacity is not None:
        first = (1.0 - weight) * (1.0 if a.opacity is None else a.opacity)
        second = weight * (1.0 if b.opacity is None else b.opacity)
        opacity = first + second
        weight = second / torch.where(opacity > 0, opacity, 1.0)
    if a.model.sheer:
        return LaneMaterial(b.model, b.values, opacity, b.readings)
    if b.model.sheer:
        return LaneMaterial(a.model, a.values, opacity, a.readings)
    values: Parameters = {"a": a.values, "b": b.values}
    readings = {side: s.readings for side, s in (("a", a), ("b", b)) if s.readings}
    if weight is None:
        readings["weight"] = reading  # type: ignore[assignment]
    else:
        values["weight"] = weight
    return LaneMaterial(kind(a.model, b.model), values, opacity, readings)


# ---- Materials: grouped by model and by what textures give; opacity by primitive


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
    places: Mapping[Node, NodePosition],
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
        members.setdefault(_group_key(materials[name], material), []).append(name)
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


def _group_key(material: ResolvedMaterial, made: LaneMaterial) -> Kind:
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
    places: Mapping[Node, NodePosition],
    device: torch.device,
) -> MaterialTextures:
    """The textures of materials of one form."""

    def binding(column: Sequence[Node]) -> TextureBinding:
        rows = torch.tensor([places[node].row for node in column], device=device)
        table, first = places[column[0]].table, column[0]
        return TextureBinding(table, rows, first.channel, any(node.filtered for node in column))

    def map_binding(column: list[Node | None]) -> TextureBinding | None:
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
        map_binding([material.normal_map for material in materials]),
        map_binding([material.bump_map for material in materials]),
        filtered=any(node.filtered for node in every),
        reads=tuple(sorted({node.reads for node in every})),
    )


def node_map_of(
    nodes: Sequence[Node | None], places: Mapping[Node, NodePosition], sizes: list[int], device: torch.device
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
    places: Mapping[Node, NodePosition],
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
