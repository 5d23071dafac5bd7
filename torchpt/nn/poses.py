"""Poses ``(..., 4, 4)`` from a rotation vector, a quaternion, or two points: differentiable functions of tensors.

They return absolute poses, for ``render(params={"camera.to_world": look_at_pose(origin, target)})``, and batches of them, as
``torchpt.render_batch`` takes for cameras. ``torchpt.nn.Renderer`` optimizes a pose relative to the scene's own, by the
parametrizations of the same names. A camera looks along its own +z, +y is up, and +x points to the image's left.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchpt.core.autograd import is_transformed
from torchpt.core.errors import SceneError
from torchpt.math.transforms import tensor_of

__all__ = [
    "PARALLEL",
    "axis_angle_matrix",
    "axis_angle_pose",
    "look_at_matrix",
    "look_at_pose",
    "pose_of",
    "quaternion_matrix",
    "quaternion_pose",
]


#: Up to this sine of their angle two directions count as parallel, as in scene files.
PARALLEL = 1e-6
#: Numbers of points, rotations and quaternions, as tensors or as lists.
Numbers = Tensor | np.ndarray | Sequence[Any]


def axis_angle_pose(rotation: Numbers, position: Numbers) -> Tensor:
    """Return the pose ``(..., 4, 4)`` turned by a rotation vector ``(..., 3)``, then moved to ``position (..., 3)``.

    The rotation vector is axis times angle in radians; 0 has a gradient too. The pose has the wider type of both.

    Raises:
        SceneError: other shapes, or numbers that are not finite (all functions of poses raise it; tensors on a GPU and under
            transforms of ``torch.func`` are not read).
    """
    rotation, position = _tensors(rotation=(rotation, 3), position=(position, 3))
    return pose_of(axis_angle_matrix(rotation).to(position.dtype), position)


def quaternion_pose(quaternion: Numbers, position: Numbers) -> Tensor:
    """Return the pose ``(..., 4, 4)`` turned by a quaternion ``(..., 4)``, then moved to ``position (..., 3)``.

    The quaternion has its real part first, and may have any length but 0. The pose has the wider type of both.

    Raises:
        SceneError: as :func:`axis_angle_pose`, or a quaternion of 0.
    """
    quaternion, position = _tensors(quaternion=(quaternion, 4), position=(position, 3))
    _check("quaternion", quaternion, (quaternion != 0).any(-1), "numbers that are not all 0")
    return pose_of(quaternion_matrix(quaternion).to(position.dtype), position)


def look_at_pose(origin: Numbers, target: Numbers, up: Numbers = (0.0, 1.0, 0.0)) -> Tensor:
    """Return the pose ``(..., 4, 4)`` at ``origin`` whose +z points to ``target``, with ``up`` in its upper half.

    It is the pose of a camera with these keys in a scene file. Points are ``(..., 3)``; ``up`` may have any length, and must
    not be parallel to the way from origin to target. The pose has the wider type of all three.

    Raises:
        SceneError: as :func:`axis_angle_pose`, a target that is the origin, or an ``up`` that is parallel to the way there.
    """
    origin, target, up = _tensors(origin=(origin, 3), target=(target, 3), up=(up, 3))
    away = target.double() - origin.double()
    _check("target", target, (away != 0).any(-1), "a point other than the origin")
    units = (torch.nn.functional.normalize(vectors.double(), dim=-1) for vectors in (up, away))
    sine = torch.linalg.vector_norm(torch.linalg.cross(*torch.broadcast_tensors(*units)), dim=-1)
    _check("up", up, sine > PARALLEL, "a direction that is not parallel to target - origin")
    return pose_of(look_at_matrix(origin, target, up).to(origin.dtype), origin)


def _tensors(**given: tuple[Any, int]) -> list[Tensor]:
    """Return numbers as tensors of one floating type on one device, whose leading dimensions are broadcast.

    Args:
        given: by name, the numbers and the length of their last dimension.

    Raises:
        SceneError: other shapes or kinds of numbers, or numbers that are not finite.
    """
    # Numbers of lists take the type and the device of tensors beside them.
    tensors = [value for value, _ in given.values() if isinstance(value, Tensor)]
    device = tensors[0].device if tensors else torch.device("cpu")
    types = [value.dtype for value in tensors if value.is_floating_point()]
    dtype = reduce(torch.promote_types, types) if types else torch.get_default_dtype()
    found: list[Tensor] = []
    for key, (value, width) in given.items():
        expected = f"numbers of shape (..., {width})"
        tensor = _tensor(key, value, device, expected)
        if tensor.dim() < 1 or tensor.shape[-1] != width:
            raise SceneError(key, tuple(tensor.shape), expected)
        if tensor.device != device:
            raise SceneError(key, str(tensor.device), f"a tensor on {device}, where the others are")
        tensor = tensor.to(dtype)
        _check(key, tensor, tensor.isfinite().all(-1), "finite numbers")
        found.append(tensor)
    try:
        torch.broadcast_shapes(*(tensor.shape[:-1] for tensor in found))
    except RuntimeError:
        shapes = tuple(tuple(tensor.shape) for tensor in found)
        raise SceneError(
            ", ".join(given), shapes, "shapes that can be broadcast, but for their last dimension"
        ) from None
    return found


def _tensor(key: str, value: Any, device: torch.device, expected: str) -> Tensor:
    """Return numbers as a tensor; a list may hold tensors, to which gradients flow."""
    if not isinstance(value, Tensor):
        if not isinstance(value, list | tuple | np.ndarray):
            raise SceneError(key, value, expected)
        try:
            value = tensor_of(value, device)
        except (TypeError, ValueError, RuntimeError, OverflowError):
            raise SceneError(key, value, expected) from None
    if value.is_complex() or value.dtype == torch.bool or value.layout is not torch.strided:
        raise SceneError(key, (tuple(value.shape), value.dtype), expected)
    return value


def _check(key: str, value: Tensor, accepted: Tensor, expected: str) -> None:
    """Raise SceneError where rows are not accepted, if that can be read without a wait for a GPU.

    Args:
        key: name of the argument.
        value: the argument ``(..., n)``.
        accepted: for each of its rows, after broadcasting with others.
        expected: what is accepted.
    """
    if torch.compiler.is_compiling() or is_transformed(accepted) or accepted.device.type != "cpu":
        return
    if not bool(accepted.all()):
        rows = value.detach().expand(*accepted.shape, value.shape[-1])
        raise SceneError(key, rows[~accepted][0].tolist(), expected)


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
    up, direction = torch.broadcast_tensors(up.double(), direction)
    left = torch.nn.functional.normalize(torch.linalg.cross(up, direction), dim=-1)
    return torch.stack((left, torch.linalg.cross(direction, left), direction), -1)
