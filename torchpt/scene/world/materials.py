"""Build the materials of the world: parameters stacked by BSDF, vertex attributes, textures and opacity by primitive.

:func:`torchpt.scene.world.assemble.assemble` calls these functions. Terms of textures (:mod:`torchpt.physics.textures.base`): a
*node* is one use of a texture; nodes that are looked up by the same code are the rows of a *table*; the *position* of a node is
its table and its row. A *reading* is the node that stands in place of a parameter. A model is *sheer* if rays pass it as if it
were not there (``null``). Materials that share BSDF and code for textures form a *group*: its parameters are stacked, one row a
material.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math.vectors import side_by_side
from torchpt.physics.bsdfs import KINDS, Bsdf, Parameters, stacked
from torchpt.physics.bsdfs.resolved import ResolvedMaterial
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.primitive import PRIMITIVES, Corners
from torchpt.physics.textures import MaterialTextures, Node, NodeMap, NodePosition, OpacityMaps, TextureBinding

__all__ = [
    "MOST_MODELS",
    "GroupKey",
    "LaneMaterial",
    "OpacityTexture",
    "lane_material",
    "members_of",
    "node_map_of",
    "opacity_maps_of",
    "opacity_of",
    "parameters_of_group",
    "textures_of_group",
    "vertex_attributes_of",
]


# ---- Vertex attributes: texture coordinates, tangents, vertex colours; each only where something reads it


def vertex_attributes_of(
    parts: Sequence[Part],
    corners: Sequence[Corners],
    sizes: list[int],
    parameters: Mapping[str, Tensor],
    materials: Mapping[str, ResolvedMaterial],
    models: Sequence[Bsdf],
    *,
    uv: bool,
) -> dict[str, Any]:
    """Return the vertex attributes of ``LaneGeometry`` by name; None for those that nothing reads.

    Args:
        parts: the parts.
        corners: their corners in the world.
        sizes: their numbers of primitives.
        parameters: every tensor by dotted name.
        materials: all materials by name.
        models: BSDFs of the groups.
        uv: True for texture coordinates even where no texture reads them.
    """
    readings = [reading for material in materials.values() for reading in material.textures()]
    # Bump maps, and filtered look-ups for the size of texels, need both derivatives of the point by texture coordinates.
    needs_bitangents = any(material.bump_map is not None for material in materials.values())
    needs_bitangents = needs_bitangents or any(reading.filtered for reading in readings)
    needs_tangents = (
        needs_bitangents
        or any(material.normal_map is not None for material in materials.values())
        or any(model.anisotropic for model in models)
    )
    needs_uvs = uv or any(reading.reads == "uv" for reading in readings)
    needs_colors = any(reading.reads == "colors" for reading in readings)
    pairs = list(zip(parts, corners, strict=True))
    kinds = [PRIMITIVES[part.kind] for part in parts]
    uvs = []  # of each part: (2, its primitives) at the three corners; tangents are computed from them
    if needs_uvs or needs_tangents:
        uvs = [kind.uvs(part, part_corners) for kind, (part, part_corners) in zip(kinds, pairs, strict=True)]
    found: dict[str, Any] = dict.fromkeys(("tangents", "bitangents", "uvs", "axes", "mirrored", "colors"))
    if needs_tangents:
        derivatives = [  # of each part: of its points by u, and by v
            kind.tangent_columns(part, part_corners, part_uvs, parameters[f"{part.name}.to_world"][:3, :3])
            for kind, (part, part_corners), part_uvs in zip(kinds, pairs, uvs, strict=True)
        ]
        found["tangents"] = side_by_side(torch.cat([by_u for by_u, _ in derivatives], 1))
        if needs_bitangents:
            found["bitangents"] = side_by_side(torch.cat([by_v for _, by_v in derivatives], 1))
    if needs_uvs:
        found["uvs"] = tuple(side_by_side(torch.cat([part_uvs[k] for part_uvs in uvs], 1)) for k in range(3))
        spheres = [parameters[f"{part.name}.to_world"] for part in parts if part.kind == "sphere"]
        if spheres:
            from torchpt.physics.shapes.primitives.sphere import axes

            found["axes"] = axes(spheres, corners[0].p0.dtype)
    if (needs_uvs or needs_bitangents) and any(c.mirrored and part.kind == "disk" for part, c in pairs):
        flags = torch.tensor([c.mirrored for c in corners], device=corners[0].p0.device)
        found["mirrored"] = torch.repeat_interleave(flags, torch.tensor(sizes, device=flags.device))
    if needs_colors:
        colors = [_colors(c) for c in corners]
        found["colors"] = tuple(side_by_side(torch.cat([triple[k] for triple in colors], 1)) for k in range(3))
    return found


def _colors(c: Corners) -> tuple[Tensor, Tensor, Tensor]:
    """Return the colours ``(3, P)`` at the three corners; 1 where a shape has none."""
    if c.colors is None:
        white = torch.ones_like(c.p0)
        return white, white, white
    assert c.faces is not None
    colors = c.colors.to(c.p0).T
    first, second, third = (colors.index_select(1, c.faces[:, k]) for k in range(3))
    return first, second, third


# ---- Materials on lanes: a BSDF, its parameters, and its opacity
#
# Differentiable in the parameters, and computed once per material. A blend with ``null`` is the other material with an opacity.


@dataclass(frozen=True)
class OpacityTexture:
    """A texture of opacity: the surface's opacity is multiplied by ``bias + factor * value``."""

    node: Node
    bias: float = 0.0
    factor: float = 1.0


@dataclass(frozen=True)
class LaneMaterial:
    """A material on lanes.

    Attributes:
        model: the BSDF.
        values: parameters without textured ones, ``(3, 1)`` or ``(1,)``; nested under ``a`` and ``b`` for a blend.
        readings: nodes of textured parameters, nested alike.
        opacity: ``(1,)``; None for 1.
        opacity_texture: the texture by which the opacity is multiplied, or None.
    """

    model: Bsdf
    values: Parameters
    opacity: Tensor | None
    readings: dict[str, Any] = field(default_factory=dict)
    opacity_texture: OpacityTexture | None = None


def lane_material(
    material: ResolvedMaterial, parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
) -> LaneMaterial:
    """Return a material on lanes.

    Args:
        material: the material.
        parameters: every tensor by dotted name.
        dtype: dtype of the lanes.
        device: device of the lanes.
    """
    readings = {key: value for key, value in material.values.items() if isinstance(value, Node)}
    values: Parameters = {
        key: parameters[f"{material.name}.{key}"].to(dtype)[..., None] for key in material.values if key not in readings
    }
    if material.inner:
        a, b = (lane_material(inner, parameters, dtype, device) for inner in material.inner)
        found = _blended(type(material.model), values.get("weight"), readings.get("weight"), a, b)
    else:
        opacity = torch.zeros(1, dtype=dtype, device=device) if material.model.sheer else None
        found = LaneMaterial(material.model, values, opacity=opacity, readings=readings)
    opacity, opacity_texture = found.opacity, found.opacity_texture
    if isinstance(material.opacity, Node):
        opacity_texture = OpacityTexture(material.opacity)
    elif material.opacity != 1.0:  # a number
        outer = parameters[f"{material.name}.opacity"].to(dtype)[None]
        opacity = outer if opacity is None else opacity * outer
    if opacity is not None and material.alpha_cutoff is not None and opacity_texture is None:
        opacity = (opacity >= material.alpha_cutoff).to(dtype)
    return LaneMaterial(
        found.model, found.values, opacity=opacity, readings=found.readings, opacity_texture=opacity_texture
    )


def _blended(
    kind: Callable[[Bsdf, Bsdf], Bsdf], weight: Tensor | None, reading: Node | None, a: LaneMaterial, b: LaneMaterial
) -> LaneMaterial:
    """Return the blend of two materials.

    With opacities o_a and o_b and the weight w of the second, a ray meets the blend with probability (1 - w) o_a + w o_b, and
    then the second material with probability w o_b over that sum: these are the opacity and the weight of the result.

    Args:
        kind: class of the blend.
        weight: ``(1,)`` weight of the second material; None where it is textured.
        reading: texture of the weight, or None.
        a: the first material.
        b: the second material.
    """
    opacity = None
    if weight is None:  # a texture: only null may have an opacity below 1 beside it
        assert reading is not None
        if a.model.sheer:
            return LaneMaterial(
                b.model, b.values, opacity=None, readings=b.readings, opacity_texture=OpacityTexture(reading)
            )
        if b.model.sheer:
            return LaneMaterial(
                a.model,
                a.values,
                opacity=None,
                readings=a.readings,
                opacity_texture=OpacityTexture(reading, bias=1.0, factor=-1.0),
            )
    elif a.opacity is not None or b.opacity is not None:
        first = (1.0 - weight) * (1.0 if a.opacity is None else a.opacity)
        second = weight * (1.0 if b.opacity is None else b.opacity)
        opacity = first + second
        weight = second / torch.where(opacity > 0, opacity, 1.0)
    if a.model.sheer:
        return LaneMaterial(b.model, b.values, opacity=opacity, readings=b.readings)
    if b.model.sheer:
        return LaneMaterial(a.model, a.values, opacity=opacity, readings=a.readings)
    values: Parameters = {"a": a.values, "b": b.values}
    readings = {side: inner.readings for side, inner in (("a", a), ("b", b)) if inner.readings}
    if weight is None:
        readings["weight"] = reading  # type: ignore[assignment]
    else:
        values["weight"] = weight
    return LaneMaterial(kind(a.model, b.model), values, opacity=opacity, readings=readings)


# ---- Groups of materials of the same BSDF and textures; opacity by primitive


#: Most groups. Lanes are sorted by 8-bit keys, two for each group (emissive or not) and one for rays without a hit.
MOST_MODELS = 120


#: Key of a group: the BSDF, and the structure of the textures (which parameters have one, and of which form); None without.
GroupKey = tuple[Bsdf, Any]


def members_of(
    materials: Mapping[str, ResolvedMaterial], lane_materials: Mapping[str, LaneMaterial]
) -> dict[GroupKey, list[str]]:
    """Return the names of the materials of each group, those of BSDF and structure of textures alike.

    Args:
        materials: the materials by name.
        lane_materials: the same materials on lanes, by name; their values are not read.

    Raises:
        SceneError: more than :data:`MOST_MODELS` groups.
    """
    members: dict[GroupKey, list[str]] = {}
    for name, material in lane_materials.items():
        members.setdefault(_group_key(materials[name], material), []).append(name)
    if not members:  # no surfaces: stages expect one group at least
        members[KINDS["diffuse"](), None] = []
    if len(members) > MOST_MODELS:
        expected = f"at most {MOST_MODELS} models, blends and textured ones counted by what they are made of"
        raise SceneError("materials", len(members), expected)
    return members


def parameters_of_group(model: Bsdf, form: Any, values: Sequence[Parameters]) -> Parameters:
    """Return the stacked parameters of a group of materials, from those of each; ``form``: of its textures, None without."""
    # Without textures the BSDF computes once what depends on parameters alone.
    compute = model.prepare if form is None else partial(_tabulated, model)
    return stacked([compute(of_material) for of_material in values], model.factors)


def textures_of_group(
    materials: Sequence[ResolvedMaterial],
    lane_materials: Sequence[LaneMaterial],
    positions: Mapping[Node, NodePosition],
    parameters: Mapping[str, Tensor],
    dtype: torch.dtype,
    device: torch.device,
) -> MaterialTextures:
    """Return the textures of a group of materials.

    Args:
        materials: the materials.
        lane_materials: the same materials on lanes.
        positions: table and row of each node.
        parameters: every tensor by dotted name.
        dtype: dtype of the lanes.
        device: device of the lanes.
    """
    bindings = _textures(materials, lane_materials, positions, device)
    strength_names = [f"{material.name}.normal_strength" for material in materials]
    if any(name in parameters for name in strength_names):
        one = torch.ones((), dtype=dtype, device=device)
        strengths = [parameters[name].to(one) if name in parameters else one for name in strength_names]
        bindings = replace(bindings, strength=torch.stack(strengths))
    return bindings


def _tabulated(model: Bsdf, values: Parameters) -> Parameters:
    """Return parameters together with the tables that the BSDF computes from them; blends nest both."""

    def merged(values: Parameters, tables: Parameters) -> Parameters:
        inner = {key: merged(values[key], table) for key, table in tables.items() if isinstance(table, dict)}
        return {**values, **tables, **inner}

    return merged(values, model.tabulate(values))


def _group_key(material: ResolvedMaterial, on_lanes: LaneMaterial) -> GroupKey:
    """Return the key of a material's group; materials without textures share that of their BSDF."""
    if not on_lanes.readings and material.normal_map is None and material.bump_map is None:
        return on_lanes.model, None

    def form(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple(sorted((key, form(item)) for key, item in value.items()))
        return value.form if isinstance(value, Node) else "number"

    maps = form(material.normal_map), form(material.bump_map)
    return on_lanes.model, (form(on_lanes.values), form(on_lanes.readings), maps)


def _textures(
    materials: Sequence[ResolvedMaterial],
    lane_materials: Sequence[LaneMaterial],
    positions: Mapping[Node, NodePosition],
    device: torch.device,
) -> MaterialTextures:
    """Return the stacked textures of the materials of one group; a ``column`` holds one slot of all of them."""

    def binding(column: Sequence[Node]) -> TextureBinding:
        rows = torch.tensor([positions[node].row for node in column], device=device)
        table, first = positions[column[0]].table, column[0]  # a group has one form, so all its nodes are in one table
        return TextureBinding(
            table=table, nodes=rows, channel=first.channel, filtered=any(node.filtered for node in column)
        )

    def map_binding(column: list[Node | None]) -> TextureBinding | None:
        nodes = [node for node in column if node is not None]
        return binding(nodes) if nodes else None

    def bound(column: list[Any]) -> Any:
        first = column[0]
        if isinstance(first, dict):
            return {key: bound([item[key] for item in column]) for key in first}
        return binding(column)

    every = [node for material in materials for node in material.textures()]
    readings = bound([one.readings for one in lane_materials])
    return MaterialTextures(
        bindings=readings,
        normal=map_binding([material.normal_map for material in materials]),
        bump=map_binding([material.bump_map for material in materials]),
        filtered=any(node.filtered for node in every),
        reads=tuple(sorted({node.reads for node in every})),
    )


def node_map_of(
    nodes: Sequence[Node | None], positions: Mapping[Node, NodePosition], sizes: list[int], device: torch.device
) -> NodeMap | None:
    """Return textures by slot: one node or None a part, repeated for its ``sizes`` slots; None where no part has one."""
    if all(node is None for node in nodes):
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)
    tables = tuple(sorted({positions[node].table for node in nodes if node is not None}))

    def spread(values: list[int]) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, device=device), size)

    rows = spread([-1 if node is None else positions[node].row for node in nodes])
    if len(tables) == 1:
        return NodeMap(nodes=rows, tables=tables, table=None)
    return NodeMap(
        nodes=rows,
        tables=tables,
        table=spread([0 if node is None else tables.index(positions[node].table) for node in nodes]),
    )


def opacity_maps_of(
    parts: Sequence[Part | Copy],
    lane_materials: Mapping[str, LaneMaterial],
    positions: Mapping[Node, NodePosition],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> OpacityMaps | None:
    """Return opacity textures by slot, for parts with ``sizes`` slots; None where there are none."""
    textures = [lane_materials[part.material.name].opacity_texture for part in parts]
    maps = node_map_of([None if texture is None else texture.node for texture in textures], positions, sizes, device)
    if maps is None:
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)

    def spread(values: list[Any], kind: torch.dtype) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, dtype=kind, device=device), size)

    cutoffs = [  # negative: none
        -1.0 if texture is None or part.material.alpha_cutoff is None else part.material.alpha_cutoff
        for texture, part in zip(textures, parts, strict=True)
    ]
    return OpacityMaps(  # where no part has a cutoff, stages do not compare
        nodes=maps.nodes,
        tables=maps.tables,
        table=maps.table,
        bias=spread([0.0 if texture is None else texture.bias for texture in textures], dtype),
        factor=spread([1.0 if texture is None else texture.factor for texture in textures], dtype),
        cutoff=spread(cutoffs, dtype) if any(cutoff >= 0 for cutoff in cutoffs) else None,
    )


def opacity_of(
    parts: Sequence[Part | Copy],
    lane_materials: Mapping[str, LaneMaterial],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor | None:
    """Return the opacity ``(P + I,)`` by slot, without textures; None where all surfaces are opaque."""
    if all(one.opacity is None and one.opacity_texture is None for one in lane_materials.values()):
        return None
    opaque = torch.ones(1, dtype=dtype, device=device)
    found = [lane_materials[part.material.name].opacity for part in parts]
    return torch.cat([(opaque if x is None else x).expand(n) for x, n in zip(found, sizes, strict=True)])
