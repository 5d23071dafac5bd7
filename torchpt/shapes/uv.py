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
    assert world.uvs is not None
    a, b, c = (take(x, at.prim) for x in world.uvs)
    uv = torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
    triangles, rectangles, disks, spheres, curved = world.counts
    if disks:
        first = triangles + rectangles
        disk = (at.prim >= first) & (at.prim < first + disks)
        square = torch.where(disk, at.u * at.u + at.v * at.v, 0.0)
        some = square > 0
        radius = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
        x, y = at.u, at.v
        if world.mirrored is not None:
            turned = take(world.mirrored, at.prim)
            x, y = torch.where(turned, y, x), torch.where(turned, x, y)
        polar = torch.stack((radius, azimuth(x, y) * (0.5 / math.pi)))
        uv = torch.where(disk, polar, uv)
    if spheres:
        assert world.axes is not None
        first = triangles + rectangles + disks
        ball = (at.prim >= first) & (at.prim < first + spheres)
        row = (at.prim - first).clamp(0, spheres - 1)
        away = at.p - take(world.p0, at.prim)
        x, y, z = (dot(take(axis, row), away) for axis in world.axes)
        square = x * x + y * y
        some = square > 0
        across = torch.where(some, torch.where(some, square, 1.0).sqrt(), 0.0)
        uv = torch.where(ball, torch.stack((azimuth(x, y) * (0.5 / math.pi), azimuth(z, across) * (1.0 / math.pi))), uv)
    if curved:
        assert at.own is not None
        here = quadrics.surface_uv(quadrics.rows(world, at.prim).code, at.own)
        uv = torch.where(at.prim >= len(world.bound) - curved, here, uv)
    return uv


def vertex_colors(world: World, at: Interaction) -> Tensor:
    """Colours ``(3, N)`` interpolated from the vertices; those of surfaces without are 1."""
    assert world.colors is not None
    a, b, c = (take(x, at.prim) for x in world.colors)
    return torch.addcmul(torch.addcmul(a * (1.0 - at.u - at.v), b, at.u), c, at.v)
