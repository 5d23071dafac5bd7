"""Materials: grouped by model and by what textures give; opacity by primitive."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpt.bsdfs import Bsdf, Diffuse, Parameters, stacked
from torchpt.errors import SceneError
from torchpt.scene.parts import Copy, MaterialSlot, Part, VertexColors
from torchpt.scene.surfaces import Surface
from torchpt.textures import Look, Node, Pick, Veils

__all__ = ["MOST_MODELS", "materials_of", "nodes_of", "opacity_of", "veils_of"]


#: Lanes are sorted by keys of 8 bits, two for each model.
MOST_MODELS = 120


#: What the lanes of a group have in common: a model, and which of its parameters are read from what.
Kind = tuple[Bsdf, Any]


def nodes_of(slots: Iterable[MaterialSlot]) -> dict[Node, int]:
    """Every way in which images are read, numbered."""
    readings = [reading for slot in slots for reading in slot.readings()]
    return {node: k for k, node in enumerate(dict.fromkeys(r for r in readings if isinstance(r, Node)))}


def materials_of(
    slots: Mapping[str, MaterialSlot],
    surfaces: Mapping[str, Surface],
    nodes: Mapping[Node, int],
    parameters: Mapping[str, Tensor],
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[
    tuple[Kind, ...],
    dict[str, tuple[int, int]],
    tuple[Parameters, ...],
    tuple[Look | None, ...],
    tuple[Tensor | None, ...],
]:
    """Groups of materials, the group and row of each, stacked parameters, textures, and which rows are two-sided."""
    groups: dict[Kind, list[str]] = {}
    for name, surface in surfaces.items():
        groups.setdefault(_kind(slots[name], surface), []).append(name)
    if not groups:
        groups[Diffuse(), None] = []
    if len(groups) > MOST_MODELS:
        expected = f"at most {MOST_MODELS} models, blends and textured ones counted by what they are made of"
        raise SceneError("materials", len(groups), expected)
    rows, tables, looks, sides = {}, [], [], []
    for number, ((model, form), names) in enumerate(groups.items()):
        rows |= {name: (number, row) for row, name in enumerate(names)}
        if form is None:
            tables.append(stacked([model.prepare(surfaces[name].values) for name in names]))
            looks.append(None)
        else:
            tables.append(stacked([_tabulated(model, surfaces[name].values) for name in names]))
            look = _look([slots[name] for name in names], [surfaces[name] for name in names], nodes, device)
            strong = [f"{name}.normal_strength" for name in names]
            if any(name in parameters for name in strong):
                one = torch.ones((), dtype=dtype, device=device)
                strengths = [parameters[name].to(one) if name in parameters else one for name in strong]
                look = replace(look, strength=torch.stack(strengths))
            looks.append(look)
        both = [slots[name].two_sided for name in names]
        sides.append(None if all(both) else torch.tensor(both, device=device))
    return tuple(groups), rows, tuple(tables), tuple(looks), tuple(sides)


def _tabulated(model: Bsdf, values: Parameters) -> Parameters:
    """Values with what the model tabulates of them."""

    def merged(a: Parameters, b: Parameters) -> Parameters:
        inner = {key: merged(a[key], value) for key, value in b.items() if isinstance(value, dict)}
        return {**a, **b, **inner}

    return merged(values, model.tabulate(values))


def _kind(slot: MaterialSlot, surface: Surface) -> Kind:
    """The group of a material; materials without textures share that of their model."""
    if not surface.readings and slot.normal_map is None and slot.bump_map is None:
        return surface.model, None

    def form(value: Any) -> Any:
        if isinstance(value, dict):
            return tuple(sorted((key, form(item)) for key, item in value.items()))
        if isinstance(value, VertexColors):
            return ("vertices", str(value.channel))
        return ("image", str(value.channel is None)) if isinstance(value, Node) else "number"

    maps = slot.normal_map is not None, slot.bump_map is not None
    return surface.model, (form(surface.values), form(surface.readings), maps)


def _look(
    slots: Sequence[MaterialSlot], surfaces: Sequence[Surface], nodes: Mapping[Node, int], device: torch.device
) -> Look:
    """The textures of materials of one form."""

    def image(column: Sequence[Node]) -> Pick:
        numbers = torch.tensor([nodes[node] for node in column], device=device)
        return Pick(numbers, column[0].channel, any(node.filtered for node in column))

    def relief(column: list[Node | None]) -> Pick | None:
        found = [node for node in column if node is not None]
        return image(found) if found else None

    def pick(column: list[Any]) -> Any:
        first = column[0]
        if isinstance(first, dict):
            return {key: pick([item[key] for item in column]) for key in first}
        if isinstance(first, VertexColors):
            return Pick(None, first.channel)
        return image(column)

    readings = pick([surface.readings for surface in surfaces])
    return Look(
        readings,
        relief([slot.normal_map for slot in slots]),
        relief([slot.bump_map for slot in slots]),
        filtered=any(isinstance(r, Node) and r.filtered for slot in slots for r in slot.readings()),
    )


def veils_of(
    parts: Sequence[Part | Copy],
    surfaces: Mapping[str, Surface],
    nodes: Mapping[Node, int],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Veils | None:
    """Textures of opacity by primitive; None where there are none."""
    covers = [surfaces[part.material.name].cover for part in parts]
    if all(cover is None for cover in covers):
        return None
    size = torch.tensor(sizes, dtype=torch.int64, device=device)

    def spread(values: list[Any], kind: torch.dtype) -> Tensor:
        return torch.repeat_interleave(torch.tensor(values, dtype=kind, device=device), size)

    cutoffs = [
        -1.0 if cover is None or part.material.alpha_cutoff is None else part.material.alpha_cutoff
        for cover, part in zip(covers, parts, strict=True)
    ]
    return Veils(
        spread([-1 if cover is None else nodes[cover.node] for cover in covers], torch.int64),
        spread([0.0 if cover is None else cover.bias for cover in covers], dtype),
        spread([1.0 if cover is None else cover.factor for cover in covers], dtype),
        spread(cutoffs, dtype) if any(cutoff >= 0 for cutoff in cutoffs) else None,
    )


def opacity_of(
    parts: Sequence[Part | Copy],
    surfaces: Mapping[str, Surface],
    sizes: list[int],
    dtype: torch.dtype,
    device: torch.device,
) -> Tensor | None:
    """The chance ``(P,)`` that a ray meets a primitive; None where it always does."""
    if all(surface.opacity is None and surface.cover is None for surface in surfaces.values()):
        return None
    whole = torch.ones(1, dtype=dtype, device=device)
    found = [surfaces[part.material.name].opacity for part in parts]
    return torch.cat([(whole if x is None else x).expand(n) for x, n in zip(found, sizes, strict=True)])
