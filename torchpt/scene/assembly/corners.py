"""Where the primitives of one part lie: corners and normals in the world, differentiable in vertices and pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import cross, dot, normalize
from torchpt.scene.parts import Part
from torchpt.scene.space import Space
from torchpt.shapes.normals import smooth_normals

__all__ = ["Corners", "corners_of"]


@dataclass(frozen=True)
class Corners:
    """The primitives of one part: ``(3, P)`` each, see :class:`~torchpt.records.Geometry`.

    Attributes:
        normals: at the corners, or None.
        faces: ``(P, 3)`` vertices at the corners; of meshes only.
        mirrored: whether a flat shape's two axes changed places.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    normals: tuple[Tensor, Tensor, Tensor] | None = None
    faces: Tensor | None = None
    mirrored: bool = False
    frame: Tensor | None = None  # (12, 1) float64: p0 e1 e2 e3 of a quadric


def corners_of(part: Part, parameters: Mapping[str, Tensor], space: Space, dtype: torch.dtype) -> Corners:
    """Place a part in the lanes' coordinates."""
    # They are folded into the pose in float64, before anything is rounded to the lanes' dtype.
    pose = parameters[f"{part.name}.to_world"].double()
    if part.local is not None:
        pose = pose @ torch.from_numpy(part.local).to(pose.device)
    linear, move = space.pose(pose).split((3, 1), 1)
    if part.kind == "sphere":
        radius = torch.linalg.det(linear).abs() ** (1.0 / 3.0)
        zero = torch.zeros_like(radius)
        p1 = torch.stack((radius, zero, zero))[:, None]
        return Corners(move.to(dtype), p1.to(dtype), torch.zeros_like(move).to(dtype))
    x, y = linear[:, 0:1], linear[:, 1:2]
    if part.kind == "quadric":
        frame = torch.cat((move, x, y, linear[:, 2:3]))
        return Corners(move.to(dtype), x.to(dtype), y.to(dtype), frame=frame)
    mirrored = bool(torch.linalg.det(linear.detach()) < 0)
    if mirrored:
        x, y = y, x  # mirrored, a flat shape still faces where its own +z goes, as in Mitsuba
    if part.kind == "rectangle":  # Mitsuba's unit shape [-1, 1]^2 from its lower corner
        x, y = 2.0 * x, 2.0 * y
        p0 = move - 0.5 * (x + y)
        return Corners(p0.to(dtype), (p0 + x).to(dtype), (p0 + y).to(dtype), mirrored=mirrored)
    if part.kind == "disk":
        p1, p2 = move + x, move + y
        return Corners(move.to(dtype), p1.to(dtype), p2.to(dtype), mirrored=mirrored)
    vertices = linear @ parameters[f"{part.name}.vertices"].T.double() + move
    device = vertices.device
    assert part.faces is not None
    faces = torch.from_numpy(part.faces).to(device)
    if mirrored:
        faces = faces[:, [0, 2, 1]]  # a mirrored mesh keeps its outside
    vertices = vertices.to(dtype)
    p0, p1, p2 = (vertices.index_select(1, faces[:, k]) for k in range(3))
    if not part.smooth:
        return Corners(p0, p1, p2, None, faces)
    if part.normals is None:
        normals = smooth_normals(vertices, faces)
    else:
        own = torch.from_numpy(part.normals).to(device)
        normals = normalize(torch.linalg.inv(linear).T @ own.T).to(dtype)
    n0, n1, n2 = (normals.index_select(1, faces[:, k]) for k in range(3))
    if not bool((dot(normals, normals) > 0).all()):  # a corner without a normal takes its face's
        flat = normalize(cross(p1 - p0, p2 - p0))
        n0, n1, n2 = (torch.where(dot(n, n) > 0, n, flat) for n in (n0, n1, n2))
    return Corners(p0, p1, p2, (n0, n1, n2), faces)
