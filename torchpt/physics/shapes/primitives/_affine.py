"""Axes of poses and affine texture coordinates, for flat primitives."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.physics.shapes.primitive import Corners, Triple

__all__ = ["axes_of", "axes_of_all", "corner_tangents", "unit_uvs"]


def axes_of(pose: Tensor) -> tuple[Tensor, Tensor, Tensor, bool]:
    """Return translation, x axis and y axis ``(3, 1)`` of a pose ``(3, 4)``, and True if it mirrors.

    A mirroring pose has x and y swapped, so that the shape faces along its transformed +z, as in Mitsuba.
    """
    move, x, y, mirrored = axes_of_all(pose[None])
    return move, x, y, mirrored[0]


def axes_of_all(poses: Tensor) -> tuple[Tensor, Tensor, Tensor, list[bool]]:
    """Return the same as :func:`axes_of` for N poses ``(N, 3, 4)``: ``(3, N)`` each."""
    x, y, move = poses[:, :, 0].T, poses[:, :, 1].T, poses[:, :, 3].T
    mirrored = torch.linalg.det(poses[:, :, :3].detach()) < 0
    flags: list[bool] = mirrored.tolist()
    if any(flags):
        x, y = torch.where(mirrored, y, x), torch.where(mirrored, x, y)
    return move, x, y, flags


def unit_uvs(corners: Corners) -> Triple:
    """Return texture coordinates ``(2, P)`` at the corners equal to the primitive's own ``u, v``."""
    like = corners.p0[:2]
    origin, u, v = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    if corners.mirrored:
        u, v = v, u
    first, second, third = (like.new_tensor(corner)[:, None].expand_as(like) for corner in (origin, u, v))
    return first, second, third


def corner_tangents(corners: Corners, uvs: Triple) -> tuple[Tensor, Tensor]:
    """Return derivatives ``(3, P)`` of points by the texture coordinates ``u`` and ``v``, from those at the corners."""
    e1, e2 = corners.p1 - corners.p0, corners.p2 - corners.p0
    a, b = uvs[1] - uvs[0], uvs[2] - uvs[0]
    det = a[0] * b[1] - a[1] * b[0]
    usable = det != 0  # else the texture coordinates of the corners lie on a line: derivatives 0
    inverse = torch.where(usable, 1.0, 0.0) / torch.where(usable, det, 1.0)
    return (e1 * b[1] - e2 * a[1]) * inverse, (e2 * a[0] - e1 * b[0]) * inverse
