"""Conversion of pinhole cameras from and to OpenCV's matrices: ``K`` in pixels, ``R`` and ``t`` from world to camera.

A point ``X`` of the world lies at ``x = R X + t`` in the camera's space, where +x is right in the picture, +y down and +z
ahead, and at ``(fx x / z + cx, fy y / z + cy)`` on the film, in pixels from its upper left *corner*: the centre of the first
pixel is (0.5, 0.5), the centre of the film (width / 2, height / 2). This is the convention of COLMAP. ``cv2`` and kornia put
(0, 0) at the centre of the first pixel: add 0.5 to ``cx`` and ``cy`` of their calibrations, as
:mod:`torchpt.scene.conventions` does.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.math.transforms import affine, constant
from torchpt.math.vectors import normalize
from torchpt.spec import Refused, reading

__all__ = [
    "DEFAULTS",
    "K_WORDS",
    "PinholeMatrices",
    "calibration",
    "extrinsics",
    "numbers_of_k",
    "parameters_of_k",
    "pose",
    "rotation",
    "size",
    "translation",
]

#: Largest error of an entry of ``R R^T`` of a rotation, as in :func:`torchpt.math.transforms.is_rigid`.
_TOLERANCE = 1e-3
#: From OpenCV's axes (right, down, ahead) to those of cameras here (left, up, ahead).
_TURN = np.diag([-1.0, -1.0, 1.0])
#: Default values of parameters that ``K`` determines; :func:`parameters_of_k` leaves them out.
DEFAULTS = {"principal_point_offset_x": 0.0, "principal_point_offset_y": 0.0, "pixel_aspect": 1.0}
#: Accepted form of ``K``, for errors.
K_WORDS = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy > 0"


class PinholeMatrices(NamedTuple):
    """The matrices of a pinhole camera in OpenCV's convention; lengths in scene units."""

    K: Tensor  # (3, 3) in pixels
    R: Tensor  # (3, 3) from the world to the camera
    t: Tensor  # (3,)


def _listed(value: Any) -> Any:
    """Convert an array or a tensor to nested lists; return anything else as it is."""
    return value.tolist() if isinstance(value, np.ndarray | Tensor) else value


def _matrix3(value: Any, expected: str) -> NDArray[np.float64]:
    """Read three rows of three finite numbers."""
    value = _listed(value)
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise Refused(expected)
    return np.array([reading.vector(row, expected) for row in value])


def rotation(value: Any) -> NDArray[np.float64]:
    """Read a rotation matrix ``(3, 3)`` from a scene file."""
    expected = "three rows of a rotation: orthogonal, and of determinant 1"
    found = _matrix3(value, expected)
    if np.abs(found @ found.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(found) < 0.0:
        raise Refused(expected)
    return found


def translation(value: Any) -> NDArray[np.float64]:
    """Read a translation ``(3,)`` from a scene file."""
    return np.array(reading.vector(_listed(value)))


def size(value: Any) -> tuple[int, int]:
    """Read width and height of a picture in pixels from a scene file."""
    expected = "[width, height] in pixels, whole numbers >= 1"
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(type(x) is int and x >= 1 for x in value):
        raise Refused(expected)
    return value[0], value[1]


def calibration(value: Any) -> NDArray[np.float64]:
    """Read ``K (3, 3)`` from a scene file; refuse skew and negative focal lengths."""
    found = _matrix3(value, K_WORDS)
    if found[0, 1] != 0.0:
        raise Refused(f"{K_WORDS} (there is no skew)", float(found[0, 1]), (0, 1))
    if found[1, 0] != 0.0 or found[2].tolist() != [0.0, 0.0, 1.0]:
        raise Refused(K_WORDS)
    for k in (0, 1):
        if not found[k, k] > 0.0:
            raise Refused(f"{K_WORDS} (y points down, and the camera looks along +z)", float(found[k, k]), (k, k))
    return found


def pose(turn: Any, move: Any) -> Any:
    """Return the pose ``(4, 4)`` from camera to world for OpenCV's ``R (3, 3)`` and ``t (3,)``, arrays or tensors."""
    return affine(turn.T @ constant(_TURN, turn), -turn.T @ move)


def extrinsics(to_world: Tensor) -> tuple[Tensor, Tensor]:
    """Return OpenCV's ``R (3, 3)`` and ``t (3,)`` of a pose ``(4, 4)``."""
    axes = normalize(to_world[:3, :3])
    turn = torch.stack((-axes[:, 0], -axes[:, 1], axes[:, 2]))
    return turn, -(turn @ to_world[:3, 3])


def numbers_of_k(matrix: Any, picture: tuple[int, int]) -> dict[str, Any]:
    """Return a pinhole's numeric parameters for ``K (3, 3)``, an array or a tensor, of a ``picture (width, height)``."""
    (width, height), fx, fy = picture, matrix[0, 0], matrix[1, 1]
    is_tensor = isinstance(fx, Tensor)
    half = torch.atan2(fx.new_tensor(0.5 * width), fx) if is_tensor else math.atan2(0.5 * width, fx)
    return {
        "fov": half * (2.0 * 180.0 / math.pi),
        "principal_point_offset_x": 0.5 - matrix[0, 2] / width,
        "principal_point_offset_y": 0.5 - matrix[1, 2] / height,
        "pixel_aspect": fy / fx,
    }


def parameters_of_k(matrix: NDArray[np.float64], picture: tuple[int, int]) -> dict[str, float | str]:
    """Return a pinhole's parameters for ``K`` of a ``picture (width, height)``, without those at their defaults."""
    found = {key: float(value) for key, value in numbers_of_k(matrix, picture).items()}
    others = {key: found[key] for key, default in DEFAULTS.items() if found[key] != default}
    return {"fov": found["fov"], "fov_axis": "x", **others}
