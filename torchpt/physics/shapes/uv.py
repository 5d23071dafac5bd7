"""Texture coordinates of surface points, as Mitsuba has them for each shape, and vertex colours.

A mesh without coordinates has those of its triangles' own ``(u, v)``. A rectangle's run over [0, 1]^2; those of other
primitives are said in their files in ``primitives/``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import take
from torchpt.physics.shapes.geometry import Interaction
from torchpt.physics.world import World

__all__ = ["surface_uv", "vertex_colors"]


def surface_uv(world: World, at: Interaction) -> Tensor:
    """Texture coordinates ``(2, N)``."""
    geometry = world.geometry
    assert geometry.uvs is not None
    a, b, c = (take(x, at.prim) for x in geometry.uvs)
    uv = torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
    for kind in geometry.kinds:
        own = kind.uv(world, at) if kind.has_own_uv else None
        if own is not None:
            uv = torch.where(geometry.of(kind, at.prim), own, uv)
    return uv


def vertex_colors(world: World, at: Interaction) -> Tensor:
    """Colours ``(3, N)`` interpolated from the vertices; those of surfaces without are 1."""
    assert world.geometry.colors is not None
    a, b, c = (take(x, at.prim) for x in world.geometry.colors)
    return torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
