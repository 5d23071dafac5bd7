"""Build the light table: a row for each emissive primitive, then one for each delta light and environment.

:func:`torchpt.scene.world.assemble.assemble` calls :func:`lights_of`. K is the number of rows. A *part* is a set of primitives
of one kind with one material and one emission; a *source* is a light of the scene file that is no surface.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchpt.math.vectors import cross, luminance
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
    """Return the radiance ``(3,)`` of an emissive part."""
    radiance, *strength = (
        parameters[name].to(dtype) for name in part.emission_names
    )  # of a material: its strength too
    if part.emission_texture is not None:
        return radiance.expand(3)  # the strength alone: stages look up the texture
    return radiance if not strength else radiance * strength[0]


def _mean_emission(part: Part, parameters: Mapping[str, Tensor]) -> float:
    """Return the mean luminance of a part's emission texture; 1 without one."""
    if part.emission_texture is None:
        return 1.0
    return float(luminance(part.emission_texture.mean(parameters).abs()))


@dataclass(frozen=True)
class _Rows:
    """Columns of :class:`~torchpt.physics.lights.records.Lights` for some rows, and their power; vectors are ``(3, rows)``."""

    kind: list[str]  # of each row
    p0: Tensor  # corner or position
    e1: Tensor  # edges
    e2: Tensor
    normal: Tensor  # unit normal or direction
    flip: Tensor  # (rows,) -1 where normals are flipped, else 1
    area: Tensor  # (rows,) by which points are sampled, see `Lights.area`
    bound: Tensor  # (rows,) rounding bound
    radiance: Tensor  # without an emission texture
    power: Tensor  # (rows,) float64, detached: the weight of the row for light samplers


def lights_of(
    parts: Sequence[Part],
    sources: Sequence[Source],
    primitives: Primitives,
    geometry: Geometry,
    parameters: Mapping[str, Tensor],
    space: Space,
    opacity: Tensor | None,
    *,
    emissive: Tensor,
    opacity_mapped: bool,
    choice: str = "auto",
    alone: bool = False,
) -> Lights | None:
    """Build the light table; None where nothing emits.

    Args:
        parts: the parts, ordered by kind.
        sources: delta lights and environments, in the order of ``lights.sort_key``.
        primitives: primitives of ``parts``.
        geometry: their geometry for the search.
        parameters: every tensor by dotted name.
        space: the coordinates of lanes.
        opacity: opacity of primitives ``(P + I,)``, or None.
        emissive: ``(P + I,)`` bool, True for primitives that emit.
        opacity_mapped: True where an emissive part has an opacity texture.
        choice: the light sampler, from ``lights.LIGHT_SAMPLERS``.
        alone: True where lights are sampled alone, not combined with BSDF sampling by MIS.
    """
    prim = emissive.nonzero().squeeze(1)  # emissive primitives, in the order of their rows
    if not len(prim) and not sources:
        return None
    dtype, device = primitives.p0.dtype, primitives.p0.device
    # Emissive parts, each with its number of primitives n.
    emitting = [(part, n) for part, n in zip(parts, primitives.sizes, strict=True) if part.emission is not None and n]
    groups, column = [], None  # groups of rows; column: column of each row in the table of quadrics
    if emitting:
        surfaces, column = _surfaces(emitting, primitives, parameters, prim)
        groups.append(surfaces)
    radius = _scene_radius(geometry) if sources else torch.ones((), dtype=torch.float64, device=device)
    environments = []
    for source in sources:
        row, environment = _source(source, parameters, space, radius, dtype, alone)
        groups.append(row)
        environments.append(environment)
    names = [name for group in groups for name in group.kind]
    kinds = tuple(dict.fromkeys(names))
    joined = {name: torch.cat([getattr(group, name) for group in groups], -1) for name in (*COLUMNS, "power")}
    source_count = len(names) - len(prim)  # rows without a surface, which come last
    power, row_opacity = joined.pop("power"), None
    if opacity is not None:
        row_opacity = torch.cat((opacity.index_select(0, prim), opacity.new_ones(source_count)))
        power = power * row_opacity.detach().double()
    row_of_prim = None  # (P + I,) -1 where a primitive does not emit
    if len(prim):
        row_of_prim = torch.full((len(emissive),), -1, dtype=torch.int64, device=device)
        row_of_prim[prim] = torch.arange(len(prim), device=device)
    if column is not None:
        column = torch.cat((column, column.new_zeros(source_count)))
    textured = opacity_mapped or any(part.emission_texture is not None for part, _ in emitting)
    # Data of the lights that are sampled by solid angle; `code` of a kind says which of these shapes it has.
    codes = {name: emitter(name).code for name in kinds}
    solid_angle_table = table_of([codes[name] for name in names], joined["p0"], joined["e1"], joined["e2"])
    lights = Lights(
        choice=None,
        kinds=kinds,
        kind=torch.tensor([kinds.index(name) for name in names], device=device) if len(names) > 1 else None,
        **joined,
        power=power,
        opacity=row_opacity,
        environment=next((environment for environment in environments if environment is not None), None),
        row_of_prim=row_of_prim,
        quadric=column,
        quadrics=None if column is None else primitives.quadrics,
        # Stages look up textures by primitive.
        prim=torch.cat((prim, prim.new_zeros(source_count))) if textured else None,
        solid=solid_angle_table,
        shapes=shapes_of(solid_angle_table),
    )
    low, high = (box.double() for box in primitive_bounds(select_primitives(geometry, prim)))
    return replace(lights, choice=light_sampler(lights, power, (low, high), choice))


def _scene_radius(geometry: Geometry) -> Tensor:
    """Return the radius ``()`` of the scene: half the diagonal of its bounding box, float64; 1 without surfaces."""
    low, high = (box.double() for box in primitive_bounds(geometry))
    return (
        (high.amax(1) - low.amin(1)).norm() * 0.5
        if low.shape[1]
        else torch.ones((), dtype=torch.float64, device=low.device)
    )


def _surfaces(
    emitting: Sequence[tuple[Part, int]], primitives: Primitives, parameters: Mapping[str, Tensor], prim: Tensor
) -> tuple[_Rows, Tensor | None]:
    """Return the rows of emissive primitives, and their columns in the table of quadrics (None without quadrics).

    Args:
        emitting: emissive parts with their number of primitives.
        primitives: all primitives of the scene.
        parameters: every tensor by dotted name.
        prim: ids of the emissive primitives, ordered by kind.
    """
    dtype, device = primitives.p0.dtype, primitives.p0.device
    counts = torch.tensor([n for _, n in emitting], dtype=torch.int64, device=device)
    names = [part.kind for part, n in emitting for _ in range(n)]
    p0, e1, e2, normal = (
        x.index_select(1, prim) for x in (primitives.p0, primitives.e1, primitives.e2, primitives.normal)
    )
    edge_cross = cross(e1, e2)
    # areas: by which points are sampled; of a quadric the area in object space times |det|. world_areas: areas in the world, by
    # which power is estimated; both float64. columns: in the table of quadrics.
    areas, world_areas, columns, needs_quadrics, start = [], [], [], False, 0
    for number, name in enumerate(KINDS):  # the order of primitives
        stop = start + names.count(name)
        if start == stop:
            continue
        kind, span = SURFACES[name], slice(start, stop)
        column = prim[span] - sum(primitives.counts[:number])  # primitives of earlier kinds come before
        faces = Faces(e1[:, span], edge_cross[:, span], column, quadrics=primitives.quadrics, frame=primitives.frame)
        area, world_area = kind.areas(faces)
        areas.append(area)
        world_areas.append(world_area)
        columns.append(column if kind.needs_quadrics else torch.zeros_like(column))
        needs_quadrics, start = needs_quadrics or kind.needs_quadrics, stop
    radiance = torch.cat([_emission(part, parameters, dtype)[:, None].expand(3, n) for part, n in emitting], 1)
    # A diffuse emitter of radiance L and area A has the power pi L A.
    power = math.pi * luminance(radiance.detach().double().abs()) * torch.cat(world_areas)
    if any(part.emission_texture is not None for part, _ in emitting):
        means = [_mean_emission(part, parameters) for part, _ in emitting]
        power = power * torch.repeat_interleave(torch.tensor(means, dtype=torch.float64, device=device), counts)
    flip, bound = (x.index_select(0, prim) for x in (primitives.sign, primitives.bound))
    rows = _Rows(
        names,
        p0,
        e1,
        e2,
        normal,
        flip=flip,
        area=torch.cat(areas).to(dtype),
        bound=bound,
        radiance=radiance,
        power=power,
    )
    return rows, torch.cat(columns) if needs_quadrics else None


def _source(
    source: Source, parameters: Mapping[str, Tensor], space: Space, radius: Tensor, dtype: torch.dtype, alone: bool
) -> tuple[_Rows, Any]:
    """Return the row of a delta light or environment, and the environment's data or None.

    Args:
        source: the light.
        parameters: every tensor by dotted name.
        space: the coordinates of lanes.
        radius: radius of the scene, float64.
        dtype: dtype of the lanes.
        alone: see :func:`lights_of`.
    """

    def parameter(key: str) -> Tensor:
        return parameters[f"{source.name}.{key}"]

    try:
        row = LIGHTS[source.kind].row(
            Setting(
                given=parameter,
                values=source.values,
                place=space.point,
                unit=space.unit,
                reach=radius,
                dtype=dtype,
                alone=alone,
            )
        )
    except Refused as error:
        raise scene_error(error, key=source.name, value=None, file=None) from None
    blank = torch.zeros(3, dtype=torch.float64, device=space.centre.device)
    columns = (blank if x is None else x for x in (row.p0, row.e1, row.e2, row.normal, row.radiance))
    p0, e1, e2, normal, radiance = (x[:, None].to(dtype) for x in columns)
    one = torch.ones(1, dtype=dtype, device=space.centre.device)
    # It has no surface: flip, area and bound are 1.
    rows = _Rows(
        [source.kind], p0, e1, e2, normal, flip=one, area=one, bound=one, radiance=radiance, power=row.power.reshape(1)
    )
    return rows, row.environment
