"""Affine transforms as float64 ``(4, 4)`` matrices that act on column vectors, built from a scene file's lists.

The camera convention is Mitsuba's: in its own frame a camera looks along +z with +y up and +x to the *left* of the
picture, so that image right is ``(target - origin) x up`` in the right-handed world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.errors import SceneError

__all__ = [
    "OPERATIONS",
    "WITHIN",
    "apply_points",
    "compose",
    "is_rigid",
    "is_singular",
    "is_usable",
    "look_at",
    "matrix4",
    "rotate",
    "scale",
    "similarity_scale",
    "translate",
    "uv_matrix",
]

Matrix = NDArray[np.float64]

#: What errors say of a matrix that is not usable.
WITHIN = "it and its inverse finite in float32 (up to 3.4e38)"

_SINGULAR = 1e-12  # smallest singular value over the largest; float64 products of a few matrices stay near 1e-15
_LARGEST = float(np.finfo(np.float32).max)
_PARALLEL = 1e-6  # sine of the angle between up and the viewing direction


def _number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _vector(value: Any, key: str, expected: str = "three finite numbers [x, y, z]") -> Matrix:
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str) or len(value) != 3:
        raise SceneError(key, value, expected)
    if not all(_number(item) for item in value):
        raise SceneError(key, value, expected)
    vector = np.array([_float(item) for item in value])
    if not np.isfinite(vector).all():
        raise SceneError(key, value, expected)
    return vector


def _float(value: Any) -> float:
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def uv_matrix(
    scale: tuple[float, float], degrees: float, translate: tuple[float, float], repeats: tuple[float, float]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Rows ``(2, 3)`` of an affine map of texture coordinates: scale, turn from u to v, move, multiply by ``repeats``."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    if degrees % 90.0 == 0.0:
        c, s = float(round(c)), float(round(s))
    (a, b), (x, y) = scale, repeats
    return (x * c * a, -x * s * b, x * translate[0]), (y * s * a, y * c * b, y * translate[1])


def is_singular(matrix: Matrix) -> bool:
    """Whether the linear part of a ``(4, 4)`` matrix has no usable inverse, whatever its scale, or is not finite."""
    linear = np.asarray(matrix)[:3, :3]
    if not np.isfinite(matrix).all():
        return True
    values = np.linalg.svd(linear, compute_uv=False)
    return bool(values[2] <= _SINGULAR * values[0])


def is_usable(matrix: Matrix) -> bool:
    """Whether a ``(4, 4)`` affine matrix can place things: it and its inverse exist and are finite in float32."""
    if not np.abs(matrix).max() <= _LARGEST:  # for NaN too
        return False
    values = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if values[2] <= _SINGULAR * values[0]:
        return False
    if 1.0 + np.abs(matrix[:3, 3]).sum() <= _LARGEST * values[2]:  # no entry of the inverse is larger than their ratio
        return True
    with np.errstate(all="ignore"):
        try:
            return bool(np.abs(np.linalg.inv(matrix)).max() <= _LARGEST)  # False for NaN too
        except np.linalg.LinAlgError:  # entries so small that their products are 0 in float64
            return False


def is_rigid(matrix: Matrix, tolerance: float = 1e-3) -> bool:
    """Whether the linear part of a ``(4, 4)`` matrix keeps lengths: a rotation or a reflection, without scale or shear."""
    linear = matrix[:3, :3]
    return bool(np.abs(linear.T @ linear - np.eye(3)).max() <= tolerance)


def similarity_scale(matrix: Matrix, tolerance: float = 1e-5) -> float | None:
    """The uniform scale of a ``(4, 4)`` similarity (rotation or reflection, translation, uniform scale), else None."""
    values = np.linalg.svd(np.asarray(matrix)[:3, :3], compute_uv=False)
    return float(values.mean()) if values[0] - values[2] <= tolerance * values[0] else None


def apply_points(matrix: Matrix, points: Matrix) -> Matrix:
    """Points ``(V, 3)`` moved by an affine ``(4, 4)`` matrix, in float64."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def translate(offset: Any, key: str = "translate") -> Matrix:
    """A translation by ``[x, y, z]``."""
    matrix = np.eye(4)
    matrix[:3, 3] = _vector(offset, key)
    return matrix


def scale(factor: Any, key: str = "scale") -> Matrix:
    """A scale by one number or by ``[x, y, z]``; a zero has no inverse and is an error."""
    expected = "a non-zero number or three of them"
    factors = np.full(3, _float(factor)) if _number(factor) else _vector(factor, key, expected)
    if not np.isfinite(factors).all() or not factors.all():
        raise SceneError(key, factor, expected)
    return np.diag([*factors, 1.0])


def rotate(argument: Any, key: str = "rotate") -> Matrix:
    """A rotation ``{axis: [x, y, z], angle: degrees}``, counter-clockwise about the axis (Rodrigues' formula)."""
    _check_keys(argument, ("axis", "angle"), key)
    axis = _vector(argument["axis"], f"{key}.axis", "a non-zero axis [x, y, z]")
    largest = np.abs(axis).max()
    if largest == 0:
        raise SceneError(f"{key}.axis", argument["axis"], "a non-zero axis [x, y, z]")
    angle = argument["angle"]
    if not _number(angle) or not np.isfinite(_float(angle)):
        raise SceneError(f"{key}.angle", angle, "a finite number of degrees")
    axis = axis / largest
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.deg2rad(_float(angle) % 360.0)
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(turn) * cross + (1.0 - np.cos(turn)) * (cross @ cross)
    return matrix


def matrix4(rows: Any, key: str = "matrix") -> Matrix:
    """An affine ``(4, 4)`` matrix from four rows of four numbers, the last one ``[0, 0, 0, 1]``."""
    expected = "four rows of four finite numbers, the last one [0, 0, 0, 1]"
    try:
        entries = [list(row) for row in rows]
    except TypeError:
        raise SceneError(key, rows, expected) from None
    if len(entries) != 4 or any(len(row) != 4 or not all(_number(item) for item in row) for row in entries):
        raise SceneError(key, rows, expected)
    matrix = np.array([[_float(item) for item in row] for row in entries])
    if not np.isfinite(matrix).all() or not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise SceneError(key, rows, expected)
    if is_singular(matrix):
        raise SceneError(key, rows, "a matrix with an inverse")
    return matrix


def look_at(origin: Any, target: Any, up: Any = (0.0, 1.0, 0.0), key: str = "look_at") -> Matrix:
    """The frame at ``origin`` whose +z points to ``target``, with ``up`` in its yz half-plane (as Mitsuba's look_at).

    Raises:
        SceneError: ``target`` coincides with ``origin``, or ``up`` is zero or parallel to the viewing direction.
    """
    eye, goal = _vector(origin, _join(key, "origin")), _vector(target, _join(key, "target"))
    above = _vector(up, _join(key, "up"))
    direction = goal - eye
    if not direction.any():
        raise SceneError(
            _join(key, "target"), target, "a point other than the origin (to the 16 digits that numbers keep)"
        )
    direction = direction / np.abs(direction).max()
    direction /= np.linalg.norm(direction)
    largest = np.abs(above).max()
    left = np.cross(above / largest, direction) if largest > 0 else np.zeros(3)
    if np.linalg.norm(left) <= _PARALLEL:
        raise SceneError(_join(key, "up"), up, "a direction that is not parallel to target - origin")
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([left, np.cross(direction, left), direction], axis=1)
    matrix[:3, 3] = eye
    return matrix


def _look_at_operation(argument: Any, key: str) -> Matrix:
    _check_keys(argument, ("origin", "target", "up"), key, optional=("up",))
    return look_at(argument["origin"], argument["target"], argument.get("up", (0.0, 1.0, 0.0)), key)


#: The operations of a transform list, by name: ``(argument, key) -> (4, 4)``.
OPERATIONS: dict[str, Callable[[Any, str], Matrix]] = {
    "translate": translate,
    "scale": scale,
    "rotate": rotate,
    "matrix": matrix4,
    "look_at": _look_at_operation,
}


def compose(operations: Any) -> Matrix:
    """One ``(4, 4)`` matrix from a list of single-key mappings, applied in the order listed.

    Args:
        operations: e.g. ``[{"scale": 2}, {"rotate": {"axis": [0, 1, 0], "angle": 30}}, {"translate": [0, 1, 0]}]``.

    Raises:
        SceneError: an entry that is malformed or singular (its ``key`` is relative to the list, e.g. ``1.rotate.axis``), or
            a product that float32 cannot hold together with its inverse (the ``key`` is empty).
    """
    names = ", ".join(OPERATIONS)
    if not isinstance(operations, list | tuple):
        raise SceneError("", operations, f"a list of {names}, each like {{translate: [0, 1, 0]}}")
    total = np.eye(4)
    for index, entry in enumerate(operations):
        if not isinstance(entry, Mapping) or len(entry) != 1:
            raise SceneError(str(index), entry, f"a mapping with one of the operations {names}")
        ((name, argument),) = entry.items()
        if name not in OPERATIONS:
            raise SceneError(f"{index}.{name}", argument, f"one of the operations {names}")
        with np.errstate(over="ignore", invalid="ignore"):
            total = OPERATIONS[name](argument, f"{index}.{name}") @ total
    if not is_usable(total):
        raise SceneError("", operations, f"operations whose product can be inverted, {WITHIN}")
    return total


def _check_keys(argument: Any, keys: tuple[str, ...], key: str, optional: tuple[str, ...] = ()) -> None:
    form = "{" + ", ".join(keys) + "}"
    if not isinstance(argument, Mapping):
        raise SceneError(key, argument, f"a mapping {form}")
    for name in argument:
        if name not in keys:
            raise SceneError(f"{key}.{name}", argument[name], f"only the keys {', '.join(keys)}")
    for name in keys:
        if name not in argument and name not in optional:
            raise SceneError(_join(key, name), None, f"a value: {form} needs it")


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name
