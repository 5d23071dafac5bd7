"""A pinhole camera as OpenCV's matrices: ``K`` in pixels, and ``R``, ``t`` from the world to the camera.

A point ``X`` of the world lies at ``x = R X + t`` in the camera's space, where +x is right in the picture, +y down and +z
ahead, and at ``(fx x / z + cx, fy y / z + cy)`` on the film, in pixels from its upper left *corner*: the middle of the first
pixel is (0.5, 0.5), and the middle of the film (width / 2, height / 2). So count COLMAP and its like. ``cv2`` itself and
kornia put (0, 0) in the middle of the first pixel: 0.5 is to be added to ``cx`` and ``cy`` of their calibrations, which
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
    "K_WORDS",
    "USUAL",
    "PinholeMatrices",
    "angles",
    "calibration",
    "extrinsics",
    "numbers_of",
    "pose",
    "rotation",
    "size",
    "translation",
]

#: OpenCV's axes in ours, which are left, up, ahead.
_TURN = np.diag([-1.0, -1.0, 1.0])
#: A number of a pinhole that ``K`` says is left out where it is this one.
USUAL = {"principal_point_offset_x": 0.0, "principal_point_offset_y": 0.0, "pixel_aspect": 1.0}
#: What is accepted of ``K``.
K_WORDS = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, fx and fy > 0"


class PinholeMatrices(NamedTuple):
    """A pinhole camera as OpenCV has it; lengths in the scene's units."""

    K: Tensor  # (3, 3) in pixels
    R: Tensor  # (3, 3) from the world to the camera
    t: Tensor  # (3,)


def _listed(value: Any) -> Any:
    """Numbers of an array or a tensor as lists."""
    return value.tolist() if isinstance(value, np.ndarray | Tensor) else value


def _square(value: Any, expected: str) -> NDArray[np.float64]:
    """Three rows of three finite numbers."""
    value = _listed(value)
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise Refused(expected)
    return np.array([reading.vector(row, expected) for row in value])


def rotation(value: Any) -> NDArray[np.float64]:
    """A rotation matrix ``(3, 3)`` as written."""
    expected = "three rows of a rotation: orthogonal, and of determinant 1"
    found = _square(value, expected)
    if np.abs(found @ found.T - np.eye(3)).max() > 1e-3 or np.linalg.det(found) < 0.0:
        raise Refused(expected)
    return found


def translation(value: Any) -> NDArray[np.float64]:
    """A translation ``(3,)`` as written."""
    return np.array(reading.vector(_listed(value)))


def size(value: Any) -> tuple[int, int]:
    """Width and height of a picture in pixels."""
    expected = "[width, height] in pixels, whole numbers >= 1"
    if not isinstance(value, list | tuple) or len(value) != 2 or not all(type(x) is int and x >= 1 for x in value):
        raise Refused(expected)
    return value[0], value[1]


def calibration(value: Any) -> NDArray[np.float64]:
    """``K (3, 3)`` as written; such as a camera here can be."""
    found = _square(value, K_WORDS)
    if found[0, 1] != 0.0:
        raise Refused(f"{K_WORDS} (there is no skew)", float(found[0, 1]), (0, 1))
    if found[1, 0] != 0.0 or found[2].tolist() != [0.0, 0.0, 1.0]:
        raise Refused(K_WORDS)
    for k in (0, 1):
        if not found[k, k] > 0.0:
            raise Refused(f"{K_WORDS} (y points down, and the camera looks along +z)", float(found[k, k]), (k, k))
    return found


def pose(turn: Any, move: Any) -> Any:
    """Return camera to world ``(4, 4)`` in our axes, from OpenCV's ``R (3, 3)`` and ``t (3,)``: arrays, or tensors."""
    return affine(turn.T @ constant(_TURN, turn), -turn.T @ move)


def extrinsics(to_world: Tensor) -> tuple[Tensor, Tensor]:
    """``R (3, 3)`` and ``t (3,)`` of a pose ``(4, 4)`` in our axes."""
    axes = normalize(to_world[:3, :3])
    turn = torch.stack((-axes[:, 0], -axes[:, 1], axes[:, 2]))
    return turn, -(turn @ to_world[:3, 3])


def numbers_of(matrix: Any, picture: tuple[int, int]) -> dict[str, Any]:
    """Return ``K (3, 3)`` of a ``picture (width, height)`` as a pinhole's numbers: of an array, or a tensor on its tape."""
    (width, height), fx, fy = picture, matrix[0, 0], matrix[1, 1]
    taped = isinstance(fx, Tensor)
    half = torch.atan2(fx.new_tensor(0.5 * width), fx) if taped else math.atan2(0.5 * width, fx)
    return {
        "fov": half * (2.0 * 180.0 / math.pi),
        "principal_point_offset_x": 0.5 - matrix[0, 2] / width,
        "principal_point_offset_y": 0.5 - matrix[1, 2] / height,
        "pixel_aspect": fy / fx,
    }


def angles(matrix: NDArray[np.float64], picture: tuple[int, int]) -> dict[str, float | str]:
    """Return ``K`` of a ``picture (width, height)`` as a pinhole's parameters; those that are as usual are left out."""
    found = {key: float(value) for key, value in numbers_of(matrix, picture).items()}
    rest = {key: found[key] for key, usual in USUAL.items() if found[key] != usual}
    return {"fov": found["fov"], "fov_axis": "x", **rest}
