"""Texture coordinates of surface points, as in Mitsuba, and vertex colours.

On a mesh without texture coordinates they are the barycentric ``(u, v)`` of each triangle; on a rectangle they cover
[0, 1]^2. The files in ``primitives/`` define the others.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.world import World

__all__ = ["surface_uv", "vertex_colors"]


def surface_uv(world: World, at: Interaction) -> Tensor:
    """Return texture coordinates ``(2, N)`` of surface points; the world must have textures."""
    geometry = world.geometry
    assert geometry.uvs is not None
    a, b, c = (take(x, at.prim) for x in geometry.uvs)
    uv = torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
    for kind in geometry.kinds:
        kind_uv = kind.uv(world, at) if kind.has_own_uv else None
        if kind_uv is not None:
            uv = torch.where(geometry.mask_of_kind(kind, at.prim), kind_uv, uv)
    return uv


def vertex_colors(world: World, at: Interaction) -> Tensor:
    """Return colours ``(3, N)`` interpolated from the vertices; 1 on surfaces without vertex colours."""
    assert world.geometry.colors is not None
    a, b, c = (take(x, at.prim) for x in world.geometry.colors)
    return torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
