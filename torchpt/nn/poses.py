"""Poses ``(..., 4, 4)`` from a rotation vector, a quaternion, or two points: differentiable functions of tensors.

They return absolute poses, for ``render(params={"camera.to_world": look_at_pose(origin, target)})``, and batches of them, as
``torchpt.render_batch`` takes for cameras. ``torchpt.nn.Renderer`` optimizes a pose relative to the scene's own, by the
parametrizations of the same names. A camera looks along its own +z, +y is up, and +x points to the image's left.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = [
    "axis_angle_matrix",
    "axis_angle_pose",
    "look_at_matrix",
    "look_at_pose",
    "pose_of",
    "quaternion_matrix",
    "quaternion_pose",
]


def axis_angle_pose(rotation: Tensor, position: Tensor) -> Tensor:
    """Return the pose ``(..., 4, 4)`` turned by a rotation vector ``(..., 3)``, then moved to ``position (..., 3)``.

    The rotation vector is axis times angle in radians; 0 has a gradient too.
    """
    return pose_of(axis_angle_matrix(rotation).to(position.dtype), position)


def quaternion_pose(quaternion: Tensor, position: Tensor) -> Tensor:
    """Return the pose ``(..., 4, 4)`` turned by a quaternion ``(..., 4)``, then moved to ``position (..., 3)``.

    The quaternion has its real part first, and may have any length but 0.
    """
    return pose_of(quaternion_matrix(quaternion).to(position.dtype), position)


def look_at_pose(origin: Tensor, target: Tensor, up: Tensor | tuple[float, float, float] = (0.0, 1.0, 0.0)) -> Tensor:
    """Return the pose ``(..., 4, 4)`` at ``origin`` whose +z points to ``target``, with ``up`` in its upper half.

    It is the pose of a camera with these keys in a scene file. Points are ``(..., 3)``; ``up`` may have any length, and must
    not be parallel to the way from origin to target.
    """
    return pose_of(look_at_matrix(origin, target, torch.as_tensor(up).to(origin)).to(origin.dtype), origin)


def pose_of(linear: Tensor, position: Tensor) -> Tensor:
    """Return the pose ``(..., 4, 4)`` of a linear part ``(..., 3, 3)`` and a position ``(..., 3)``, which are broadcast."""
    lead = torch.broadcast_shapes(linear.shape[:-2], position.shape[:-1])
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=linear.dtype, device=linear.device).expand(*lead, 1, 4)
    top = torch.cat((linear.expand(*lead, 3, 3), position[..., None].expand(*lead, 3, 1)), -1)
    return torch.cat((top, last), -2)


def axis_angle_matrix(rotation: Tensor) -> Tensor:
    """Return the rotation ``(..., 3, 3)`` of rotation vectors ``(..., 3)``, in float64: large angles keep their digits."""
    # Rodrigues' rotation: the exponential of the cross-product matrix of axis times angle.
    a, b, c = rotation.double().unbind(-1)
    zero = torch.zeros_like(a)
    cross_matrix = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], -1).reshape(*a.shape, 3, 3)
    return torch.linalg.matrix_exp(cross_matrix)


def quaternion_matrix(quaternion: Tensor) -> Tensor:
    """Return the rotation ``(..., 3, 3)`` of quaternions ``(..., 4)``, real part first, in float64."""
    q = quaternion.double()
    w, x, y, z = (q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*w.shape, 3, 3)


def look_at_matrix(origin: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the axes ``(..., 3, 3)`` of :func:`look_at_pose` as columns, in float64."""
    direction = torch.nn.functional.normalize(target.double() - origin.double(), dim=-1)
    up = up.double().expand_as(direction)
    left = torch.nn.functional.normalize(torch.linalg.cross(up, direction), dim=-1)
    return torch.stack((left, torch.linalg.cross(direction, left), direction), -1)
