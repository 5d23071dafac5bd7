"""Texture coordinates of surface points, and how the point moves with them; as Mitsuba has them for each shape.

A mesh without coordinates has those of its triangles' own ``(u, v)``. A rectangle's run over [0, 1]^2; a disk's are the
distance from its centre and the azimuth; a sphere's the azimuth about its z axis and the angle from it; those of the sides of a
cylinder and a cone the azimuth and the height.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchpt.math.angles import azimuth
from torchpt.math.vectors import dot, take
from torchpt.records import Interaction, World
from torchpt.shapes import quadrics

__all__ = ["surface_uv", "vertex_colors"]


def surface_uv(world: World, at: Interaction) -> Tensor:
    """Texture coordinates ``(2, N)``."""
    assert world.geometry.uvs is not None
    a, b, c = (take(x, at.prim) for x in world.geometry.uvs)
    uv = torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
    if not any(world.geometry.counts[2:]):
        return uv
    x, y, z, level = _own(world, at)
    square = torch.addcmul(x * x, y, y)
    some = square > 0
    across = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
    turn = azimuth(x, y) * (0.5 / math.pi)
    disk = level == 0
    first = torch.where(disk, across, turn)
    # On sides the height, on balls the angle from the pole.
    second = torch.where(disk, turn, torch.where(level > 1, azimuth(z, across) * (1.0 / math.pi), z))
    return torch.where(at.prim >= world.geometry.ends[1], torch.stack((first, second)), uv)


def _own(world: World, at: Interaction) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points ``x, y, z (N,)`` of round shapes in their own space, and 0 on disks, 1 on sides, 2 on balls."""
    spheres, curved = world.geometry.counts[3:]
    x, y, z, level = at.u, at.v, torch.zeros_like(at.u), torch.zeros_like(at.prim)
    if world.geometry.mirrored is not None:
        turned = take(world.geometry.mirrored, at.prim)
        x, y = torch.where(turned, y, x), torch.where(turned, x, y)
    if spheres:
        assert world.geometry.axes is not None
        first, end = world.geometry.ends[2], world.geometry.ends[3]
        ball = (at.prim >= first) & (at.prim < end)
        row = torch.minimum((at.prim - first).clamp_min(0), end - first - 1)
        away = at.p - take(world.geometry.p0, at.prim)
        axes = [dot(take(axis, row), away) for axis in world.geometry.axes]
        x, y, z = (torch.where(ball, axis, other) for axis, other in zip(axes, (x, y, z), strict=True))
        level = torch.where(ball, 2, level)
    if curved and at.own is not None:  # a point on lights of other kinds has none
        other = at.prim >= world.geometry.ends[3]
        x, y, z = (torch.where(other, own, value) for own, value in zip(at.own, (x, y, z), strict=True))
        code = quadrics.rows(world, at.prim).code
        level = torch.where(other, torch.where(code == 0, 2, 1), level)
    return x, y, z, level


def vertex_colors(world: World, at: Interaction) -> Tensor:
    """Colours ``(3, N)`` interpolated from the vertices; those of surfaces without are 1."""
    assert world.geometry.colors is not None
    a, b, c = (take(x, at.prim) for x in world.geometry.colors)
    return torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
