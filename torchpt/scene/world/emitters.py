"""The table of lights: a row for each emissive primitive, then one for each light that is no surface."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.math.vectors import luminance
from torchpt.physics.lights import COLUMNS, SURFACES, Faces, Setting, emitter, light_sampler
from torchpt.physics.lights import KINDS as LIGHTS
from torchpt.physics.lights.records import Lights
from torchpt.physics.lights.solid_angle import shapes_of, table_of
from torchpt.physics.parts import Part, Source
from torchpt.physics.shapes.geometry import KINDS, Geometry
from torchpt.scene.space import Space
from torchpt.scene.world.primitives import Primitives
from torchpt.search.bounds import primitive_bounds, select_primitives
from torchpt.spec import Refused
from torchpt.spec.schema import scene_error

__all__ = ["lights_of"]


def _emission(part: Part, parameters: Mapping[str, Tensor], dtype: torch.dtype) -> Tensor:
    """Radiance ``(3,)`` of a part that emits."""
    radiance, *strength = (parameters[name].to(dtype) for name in part.emission_names)
    if part.emission_texture is not None:
        return radiance.expand(3)  # the strength alone: the texture's share is looked up
    return radiance if not strength else radiance * strength[0]


def _mean_emission(part: Part, parameters: Mapping[str, Tensor]) -> float:
    """Mean luminance of the texture that a part shines by; 1 without."""
    if part.emission_texture is None:
        return 1.0
    return float(luminance(part.emission_texture.mean(parameters).abs()))


@dataclass(frozen=True)
class _Rows:
    """Columns of :class:`~torchpt.physics.lights.records.Lights` for some of its rows, and their power."""

    kind: list[str]  # of each row
    p0: Tensor
    e1: Tensor
    e2: Tensor
    normal: Tensor
    flip: Tensor
    area: Tensor
    bound: Tensor
    radiance: Tensor
    power: Tensor  # float64, detached


def lights_of(
    parts: Sequence[Part],
    sources: Sequence[Source],
    primitives: Primitives,
    geometry: Geometry,
    parameters: Mapping[str, Tensor],
    space: Space,
    opacity: Tensor | None,
    emissive: Tensor,
    opacity_mapped: bool,
    choice: str = "auto",
) -> Lights | None:
    """The lights; None where nothing emits.

    Args:
        parts: ordered by kind.
        sources: lights that are no surfaces, in the order of ``lights.sort_key``.
        primitives: of ``parts``.
        geometry: of them, as the search sees it.
        parameters: every tensor by dotted name.
        space: the lanes' coordinates.
        opacity: ``(P + I,)``, or None.
        emissive: ``(P + I,)`` bool, which primitives emit.
        opacity_mapped: whether opacity textures opacity_texture any of them.
        choice: how one of them is chosen, from ``lights.LIGHT_SAMPLERS``.
    """
    prim = emissive.nonzero().squeeze(1)
    if not len(prim) and not sources:
        return None
    dtype, device = primitives.p0.dtype, primitives.p0.device
    emitting = [(part, n) for part, n in zip(parts, primitives.sizes, strict=True) if part.emission is not None and n]
    groups, column = [], None
    if emitting:
        surfaces, column = _surfaces(emitting, primitives, parameters, prim)
        groups.append(surfaces)
    reach = _reach(geometry) if sources else torch.ones((), device=device)
    made = [_source(source, parameters, space, reach, dtype) for source in sources]
    groups += [row for row, _ in made]
    names = [name for group in groups for name in group.kind]
    kinds = tuple(dict.fromkeys(names))
    joined = {name: torch.cat([getattr(group, name) for group in groups], -1) for name in (*COLUMNS, "power")}
    rest = len(names) - len(prim)
    power, seen = joined.pop("power"), None
    if opacity is not None:
        seen = torch.cat((opacity.index_select(0, prim), opacity.new_ones(rest)))
        power = power * seen.detach().double()
    index = None
    if len(prim):
        index = torch.full((len(emissive),), -1, dtype=torch.int64, device=device)
        index[prim] = torch.arange(len(prim), device=device)
    if column is not None:
        column = torch.cat((column, column.new_zeros(rest)))
    textured = opacity_mapped or any(part.emission_texture is not None for part, _ in emitting)
    many = len(names) > 1
    codes = {name: emitter(name).code for name in kinds}
    solid = table_of([codes[name] for name in names], joined["p0"], joined["e1"], joined["e2"])
    lights = Lights(
        choice=None,
        kinds=kinds,
        kind=torch.tensor([kinds.index(name) for name in names], device=device) if many else None,
        **joined,
        opacity=seen,
        environment=next((around for _, around in made if around is not None), None),
        row_of_prim=index,
        quadric=column,
        quadrics=None if column is None else primitives.quadrics,
        prim=torch.cat((prim, prim.new_zeros(rest))) if textured else None,
        solid=solid,
        shapes=shapes_of(solid),
    )
    low, high = (box.double() for box in primitive_bounds(select_primitives(geometry, prim)))
    return replace(lights, choice=light_sampler(lights, power, (low, high), choice))


def _reach(geometry: Geometry) -> Tensor:
    """Radius of the scene: half the diagonal of its box, float64."""
    low, high = (box.double() for box in primitive_bounds(geometry))
    return (high.amax(1) - low.amin(1)).norm() * 0.5 if low.shape[1] else torch.ones((), device=low.device)


def _surfaces(
    emitting: Sequence[tuple[Part, int]], primitives: Primitives, parameters: Mapping[str, Tensor], prim: Tensor
) -> tuple[_Rows, Tensor | None]:
    """Rows of emissive primitives ``prim``, and where any is a quadric their columns among the quadrics."""
    dtype, device = primitives.p0.dtype, primitives.p0.device
    counts = torch.tensor([n for _, n in emitting], dtype=torch.int64, device=device)
    names = [part.kind for part, n in emitting for _ in range(n)]
    p0, e1, e2, face, normal = (
        x.index_select(1, prim)
        for x in (primitives.p0, primitives.e1, primitives.e2, primitives.face, primitives.normal)
    )
    areas, wholes, columns, needs_quadrics, start = [], [], [], False, 0
    for number, name in enumerate(KINDS):  # in whose order the primitives are
        stop = start + names.count(name)
        if start == stop:
            continue
        kind, span = SURFACES[name], slice(start, stop)
        column = prim[span] - sum(primitives.counts[:number])
        area, whole = kind.areas(Faces(e1[:, span], face[:, span], column, primitives.quadrics, primitives.frame))
        areas.append(area)
        wholes.append(whole)
        columns.append(column if kind.needs_quadrics else torch.zeros_like(column))
        needs_quadrics, start = needs_quadrics or kind.needs_quadrics, stop
    radiance = torch.cat([_emission(part, parameters, dtype)[:, None].expand(3, n) for part, n in emitting], 1)
    power = math.pi * luminance(radiance.detach().double().abs()) * torch.cat(wholes)
    if any(part.emission_texture is not None for part, _ in emitting):
        shares = [_mean_emission(part, parameters) for part, _ in emitting]
        power = power * torch.repeat_interleave(torch.tensor(shares, dtype=torch.float64, device=device), counts)
    flip, bound = (x.index_select(0, prim) for x in (primitives.sign, primitives.bound))
    made = _Rows(names, p0, e1, e2, normal, flip, torch.cat(areas).to(dtype), bound, radiance, power)
    return made, torch.cat(columns) if needs_quadrics else None


def _source(
    source: Source, parameters: Mapping[str, Tensor], space: Space, reach: Tensor, dtype: torch.dtype
) -> tuple[_Rows, Any]:
    """The row of a light that is no surface, and what it has of an environment.

    Args:
        source: the light.
        parameters: every tensor by dotted name.
        space: the lanes' coordinates.
        reach: radius of the scene, float64.
        dtype: of the lanes.
    """

    def given(key: str) -> Tensor:
        return parameters[f"{source.name}.{key}"]

    try:
        row = LIGHTS[source.kind].row(Setting(given, source.values, space.point, space.unit, reach, dtype))
    except Refused as error:
        raise scene_error(error, source.name, None, None) from None
    blank = torch.zeros(3, dtype=torch.float64, device=space.centre.device)
    columns = (blank if x is None else x for x in (row.p0, row.e1, row.e2, row.normal, row.radiance))
    p0, e1, e2, normal, light = (x[:, None].to(dtype) for x in columns)
    one = torch.ones(1, dtype=dtype, device=space.centre.device)
    return _Rows([source.kind], p0, e1, e2, normal, one, one, one, light, row.power.reshape(1)), row.environment
