"""Worlds joined: primitives by kind, and of a kind by scene; tables follow each other, and what points into them is moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from torchpt.accel.numbers import Numbers
from torchpt.bsdfs import Parameters
from torchpt.bsdfs.base import Table as Tabulated
from torchpt.math.vectors import take
from torchpt.records import Copies, LaneGeometry, LaneMaterials, LaneTextures, Quadrics, World
from torchpt.textures import MaterialTextures, NodeMap, OpacityMaps, TextureBinding
from torchpt.union.lights import joined_lights

__all__ = ["joined_world"]

#: Of a geometry, tensors ``(..., P)`` by primitive.
_BY_PRIMITIVE = ("p0", "e1", "e2", "normal", "bound", "flip", "tangents", "bitangents", "mirrored")
_BY_CORNER = ("normals", "uvs", "colors")


def joined_world(worlds: Sequence[World]) -> tuple[World, Numbers]:
    """Worlds of one form as one, and the numbers that their primitives have in it."""
    geometries = [world.geometry for world in worlds]
    numbers = _numbers(geometries)
    quadrics = None if geometries[0].quadrics is None else _quadrics([g.quadrics for g in geometries if g.quadrics])
    textures = [world.textures for world in worlds]
    begin = [_starts([table.count for table in tables]) for tables in _columns([t.tables for t in textures])]
    lights = [world.lights for world in worlds if world.lights is not None]
    world = World(
        geometry=_geometry(geometries, numbers, quadrics),
        materials=_materials([world.materials for world in worlds], numbers, begin),
        textures=LaneTextures(
            tables=tuple(type(own[0]).joined(own) for own in _columns([t.tables for t in textures])),
            opacity=_maps([t.opacity for t in textures], numbers, begin),
            emission=_maps([t.emission for t in textures], numbers, begin),
        ),
        lights=joined_lights(lights, numbers, quadrics) if lights else None,
    )
    return world, numbers


def _numbers(geometries: Sequence[LaneGeometry]) -> Numbers:
    ends = None
    if geometries[0].copies is not None:
        # No copy has more primitives than its scene.
        ends = [int(g.copies.start[-1]) + sum(g.counts) for g in geometries if g.copies]
    return Numbers.by_kind([g.counts for g in geometries], geometries[0].p0.device, ends)


def _starts(sizes: Sequence[int]) -> list[int]:
    return [0, *accumulate(sizes)][:-1]


def _columns(rows: Sequence[Sequence[Any]]) -> list[tuple[Any, ...]]:
    return list(zip(*rows, strict=True))


def _joined(values: Sequence[Tensor | None], join: Callable[[Sequence[Tensor]], Tensor]) -> Tensor | None:
    """Tensors joined, where there are any."""
    there = [value for value in values if value is not None]
    return join(there) if there else None


def _along(values: Sequence[Tensor | None]) -> Tensor | None:
    return _joined(values, lambda there: torch.cat(list(there), -1))


def _geometry(geometries: Sequence[LaneGeometry], numbers: Numbers, quadrics: Quadrics | None) -> LaneGeometry:
    one, found = geometries[0], dict[str, Any]()
    for name in _BY_PRIMITIVE:
        found[name] = _joined([getattr(g, name) for g in geometries], numbers.primitives)
    for name in _BY_CORNER:
        if getattr(one, name) is not None:
            corners = _columns([getattr(g, name) for g in geometries])
            found[name] = tuple(numbers.primitives(corner) for corner in corners)
    if one.axes is not None:
        found["axes"] = tuple(torch.cat(axis, 1) for axis in _columns([g.axes for g in geometries if g.axes]))
    copies = None
    if one.copies is not None:
        copies = _copies([g.copies for g in geometries if g.copies], numbers)
    return replace(
        one,
        **found,
        counts=numbers.counts,
        ends=torch.tensor(numbers.counts, device=one.ends.device).cumsum(0),
        object_id=numbers.slots([g.object_id for g in geometries]),
        quadrics=quadrics,
        copies=copies,
    )


def _quadrics(tables: Sequence[Quadrics]) -> Quadrics:
    names = [f.name for f in fields(Quadrics) if f.name != "kinds"]
    return replace(tables[0], **{name: _along([getattr(table, name) for table in tables]) for name in names})


def _copies(tables: Sequence[Copies], numbers: Numbers) -> Copies:
    """Copies of all scenes, the identity once; their numbers and those of their meshes are those among all."""
    assert numbers.shifts is not None
    found: dict[str, list[Tensor]] = {f.name: [getattr(tables[0], f.name)[..., :1]] for f in fields(Copies)}
    for scene, (table, shift) in enumerate(zip(tables, numbers.shifts, strict=True)):
        for name, columns in found.items():
            own = getattr(table, name)[..., 1:]
            if name == "start":
                own = own + shift
            elif name == "first":
                own = take(numbers.own(scene), own)
            columns.append(own)
    return Copies(**{name: torch.cat(columns, -1) for name, columns in found.items()})


def _materials(every: Sequence[LaneMaterials], numbers: Numbers, begin: Sequence[Sequence[int]]) -> LaneMaterials:
    """Materials of all scenes; ``begin``: of each table of textures, where each scene's nodes begin."""
    one, count = every[0], len(every[0].models)
    rows = [_starts([_rows(m, number) for m in every]) for number in range(count)]
    moved = []
    for scene, materials in enumerate(every):
        by = torch.tensor([starts[scene] for starts in rows], device=materials.row.device)
        moved.append(materials.row + take(by, materials.key[1:].long() % count))
    return LaneMaterials(
        row=numbers.slots(moved),
        key=torch.cat((one.key[:1], numbers.slots([m.key[1:] for m in every]))),
        models=one.models,
        parameters=tuple(_stacked(own) for own in _columns([m.parameters for m in every])),
        textures=tuple(_textures(own, begin) for own in _columns([m.textures for m in every])),
        two_sided=tuple(_along(own) for own in _columns([m.two_sided for m in every])),
        opacity=_joined([m.opacity for m in every], numbers.slots),
    )


def _rows(materials: LaneMaterials, number: int) -> int:
    """How many materials a model has."""
    textures, sides = materials.textures[number], materials.two_sided[number]
    return max(
        _length(materials.parameters[number]),
        0 if textures is None else _length(textures.readings),
        *(len(b.nodes) for b in (textures.normal, textures.bump) if b) if textures else (),
        0 if sides is None else len(sides),
    )


def _length(values: Any) -> int:
    """How many rows nested parameters have, or what reads them of textures."""
    if isinstance(values, dict):
        return max((_length(value) for value in values.values()), default=0)
    if isinstance(values, TextureBinding):
        return len(values.nodes)
    if isinstance(values, Tabulated):
        return len(values.values) // values.count
    return 0 if values is None else values.shape[-1]


def _stacked(every: Sequence[Parameters]) -> Parameters:
    """Parameters of a model, the rows of all scenes one after another."""
    found: Parameters = {}
    for name, first in every[0].items():
        column = [values[name] for values in every]
        if isinstance(first, dict):
            found[name] = _stacked(column)
        elif isinstance(first, Tabulated):
            found[name] = replace(first, values=torch.cat([table.values for table in column]))
        else:
            found[name] = _along(column)
    return found


def _textures(every: Sequence[MaterialTextures | None], begin: Sequence[Sequence[int]]) -> MaterialTextures | None:
    there = [textures for textures in every if textures is not None]
    if not there:
        return None

    def binding(column: Sequence[TextureBinding | None]) -> TextureBinding | None:
        own = [b for b in column if b is not None]
        if not own:
            return None
        moved = [b.nodes + start for b, start in zip(own, begin[own[0].table], strict=True)]
        return replace(own[0], nodes=torch.cat(moved))

    def bound(column: Sequence[Any]) -> Any:
        if isinstance(column[0], dict):
            return {key: bound([item[key] for item in column]) for key in column[0]}
        return binding(column)

    return replace(
        there[0],
        readings=bound([t.readings for t in there]),
        normal=binding([t.normal for t in there]),
        bump=binding([t.bump for t in there]),
        strength=_along([t.strength for t in there]),
    )


def _maps(every: Sequence[Any], numbers: Numbers, begin: Sequence[Sequence[int]]) -> Any:
    """Textures by primitive and copy."""
    there: list[NodeMap] = [maps for maps in every if maps is not None]
    if not there:
        return None
    nodes = []
    for scene, maps in enumerate(there):
        by = torch.tensor([begin[table][scene] for table in maps.tables], device=maps.nodes.device)
        shift = by[0] if maps.table is None else take(by, maps.table)
        nodes.append(torch.where(maps.nodes < 0, maps.nodes, maps.nodes + shift))
    own = ("table", "bias", "factor", "cutoff") if isinstance(there[0], OpacityMaps) else ("table",)
    more = {name: _joined([getattr(maps, name) for maps in there], numbers.slots) for name in own}
    return replace(there[0], nodes=numbers.slots(nodes), **more)
