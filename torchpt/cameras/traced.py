"""What a camera's block comes to, of tensors: differentiable, the numbers of :mod:`torchpt.cameras.poses` and ``opencv``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torchpt.cameras.poses import UP
from torchpt.math.tensor_transforms import look_at, placed, tensor_of

__all__ = ["angles_of", "opencv_pose", "pose_of"]


def pose_of(written: Mapping[str, Any], device: torch.device) -> Tensor:
    """Camera to world ``(4, 4)`` of a block that is known to be right; see :func:`torchpt.cameras.poses.pose_of`."""
    given = {key: tensor_of(value, device) for key, value in written.items() if key in _KEYS and value is not None}
    if "to_world" in given:
        return placed(given["to_world"][:3, :3], given["to_world"][:3, 3])
    if "R" in given:
        return opencv_pose(given["R"], given["t"])
    return look_at(given["origin"], given["target"], given.get("up", tensor_of(UP, device)))


_KEYS = ("origin", "target", "up", "to_world", "R", "t")


def opencv_pose(turn: Tensor, move: Tensor) -> Tensor:
    """Camera to world ``(4, 4)`` of OpenCV's ``R (3, 3)`` and ``t (3,)``; see :func:`torchpt.cameras.opencv.pose`."""
    return placed(turn.T * turn.new_tensor([-1.0, -1.0, 1.0]), -(turn.T @ move))


def angles_of(matrix: Tensor, picture: tuple[int, int]) -> dict[str, Tensor]:
    """``K (3, 3)`` of a ``picture (width, height)`` as a pinhole's numbers; see :func:`torchpt.cameras.opencv.angles`."""
    width, height = picture
    fx, fy = matrix[0, 0], matrix[1, 1]
    return {
        "fov": torch.atan2(torch.full_like(fx, 0.5 * width), fx) * (2.0 * 180.0 / math.pi),
        "principal_point_offset_x": 0.5 - matrix[0, 2] / width,
        "principal_point_offset_y": 0.5 - matrix[1, 2] / height,
        "pixel_aspect": fy / fx,
    }
