"""Arbitrary output variables: what the first surface is, without light transport."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.integrators.path import partition
from torchpt.integrators.search import Search
from torchpt.integrators.surfaces import parameters_at, shading_normal, spot_at
from torchpt.math.vectors import take
from torchpt.records import PathState, World, rows
from torchpt.shapes import interact, surface_uv

__all__ = ["CHANNELS", "NAMES", "first_hit"]

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
    camera, ``object_id`` the order of the shape in the scene, from 1. ``pixel``: see ``surfaces.spot_at``.
    """
    hit = search.nearest(state, 1)
    layers = {name: torch.zeros(CHANNELS[name], len(hit.t), dtype=dtype, device=centre.device) for name in names}
    _, groups = partition(world, hit)
    for model, index in groups:
        found = rows(hit, index)
        at = interact(world, take(state.o, index), take(state.d, index), found)
        spot = spot_at(world, model, at, pixel)
        values: dict[str, Tensor] = {}
        if "albedo" in names:
            parameters = parameters_at(world, model, take(world.material, at.slot), at, spot)
            values["albedo"] = world.models[model].albedo(parameters)
        if "normal" in names:
            values["normal"] = shading_normal(world, model, take(state.d, index), at, spot)
        if "uv" in names:
            values["uv"] = surface_uv(world, at)
        if "depth" in names:
            values["depth"] = found.t[None]
        if "position" in names:
            values["position"] = at.p + centre.to(dtype)[:, None]
        if "object_id" in names:
            values["object_id"] = take(world.object_id, at.slot).to(dtype)[None]
        for name, value in values.items():
            layers[name].scatter_(1, index.expand(len(value), -1), value)
    return layers
