"""Arbitrary output variables: what the first surface is, without light transport."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.integrators.path import partition
from torchpt.integrators.search import Search
from torchpt.integrators.surfaces import parameters_at, shading_normal, texture_point_at
from torchpt.math.vectors import take
from torchpt.records import Hit, PathState, World, rows
from torchpt.shapes import interact, surface_uv

__all__ = ["CHANNELS", "NAMES", "first_hit", "values"]

#: Layers and how many channels each has. A miss is 0 in all of them.
CHANNELS = {"albedo": 3, "normal": 3, "depth": 1, "position": 3, "uv": 2, "object_id": 1}
#: Layers that name things: a pixel shows what its first sample met, since names have no average.
NAMES = ("object_id",)


def first_hit(
    names: tuple[str, ...],
    world: World,
    search: Search,
    state: PathState,
    centre: Tensor,
    dtype: torch.dtype,
    pixel: Tensor | None = None,
) -> dict[str, Tensor]:
    """The layers ``names``, each ``(C, N)``, for camera rays ``state``.

    ``albedo`` is the material's reflectance, ``normal`` the shading normal in the world, ``depth`` the distance from the
    camera, ``object_id`` the order of the shape in the scene, from 1. ``pixel``: see ``surfaces.texture_point_at``.
    """
    hit = search.nearest(state, 1)
    layers = {name: torch.zeros(CHANNELS[name], len(hit.t), dtype=dtype, device=centre.device) for name in names}
    _, groups = partition(world, hit)
    for model, index in groups:
        found = rows(hit, index)
        here = values(names, world, model, take(state.o, index), take(state.d, index), found, centre, dtype, pixel)
        for name, value in here.items():
            layers[name].scatter_(1, index.expand(len(value), -1), value)
    return layers


def values(
    names: tuple[str, ...],
    world: World,
    model: int,
    o: Tensor,
    d: Tensor,
    hit: Hit,
    centre: Tensor,
    dtype: torch.dtype,
    pixel: Tensor | None,
) -> dict[str, Tensor]:
    """The layers ``names``, each ``(C, n)``, where rays ``o, d`` hit surfaces of one model; see :func:`first_hit`."""
    at = interact(world, o, d, hit)
    point = texture_point_at(world, model, at, pixel)
    found: dict[str, Tensor] = {}
    if "albedo" in names:
        parameters = parameters_at(world, model, take(world.materials.row, at.slot), at, point)
        found["albedo"] = world.materials.models[model].albedo(parameters)
    if "normal" in names:
        found["normal"] = shading_normal(world, model, d, at, point)
    if "uv" in names:
        found["uv"] = surface_uv(world, at)
    if "depth" in names:
        found["depth"] = hit.t[None]
    if "position" in names:
        found["position"] = at.p + centre.to(dtype)[:, None]
    if "object_id" in names:
        found["object_id"] = take(world.geometry.object_id, at.slot).to(dtype)[None]
    return found
