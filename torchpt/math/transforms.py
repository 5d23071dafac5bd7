"""Affine transforms as float64 ``(4, 4)`` matrices that act on column vectors, from the lists of scene files.

Each operation is one formula for numpy and torch. Without a device it checks its arguments and returns an array; with a device
it returns a tensor there, differentiable by the tensors among its arguments, which must have been checked before.

The camera convention is Mitsuba's: in its own frame a camera looks along +z with +y up and +x to the *left* of the
picture, so that image right is ``(target - origin) x up`` in the right-handed world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.errors import SceneError

__all__ = [
    "FINITE_WORDS",
    "OPERATIONS",
    "affine",
    "apply_points",
    "compose",
    "constant",
    "is_rigid",
    "is_singular",
    "is_usable",
    "look_at",
    "matrix4",
    "rotate",
    "scale",
    "similarity_scale",
    "tensor_of",
    "translate",
    "uv_matrix",
]

Matrix = NDArray[np.float64]
#: An array of numpy, or a tensor.
Array = Any
Device = torch.device | None

#: Words of errors about a matrix that is not usable: they follow a phrase such as "a matrix that can be inverted".
FINITE_WORDS = "it and its inverse finite in float32 (up to 3.4e38)"

_SINGULAR = 1e-12  # smallest singular value over the largest; rounding of a few float64 products stays near 1e-15
_LARGEST = float(np.finfo(np.float32).max)
_PARALLEL = 1e-6  # up to this sine of their angle, up and the viewing direction count as parallel


def tensor_of(value: Any, device: torch.device) -> Tensor:
    """Convert a number, or nested lists of numbers and tensors, to one float64 tensor on a device."""
    if isinstance(value, Tensor):
        return value.to(device, torch.float64)
    if isinstance(value, list | tuple):
        return torch.stack([tensor_of(item, device) for item in value])
    return torch.as_tensor(np.asarray(value, np.float64), device=device)


def constant(values: Any, like: Array) -> Array:
    """Return numbers as an array, or as a tensor of the dtype and device of ``like`` if that is a tensor."""
    return like.new_tensor(values) if isinstance(like, Tensor) else np.asarray(values, np.float64)


def affine(linear: Array, origin: Array) -> Array:
    """Return the ``(4, 4)`` matrix of a linear part ``(3, 3)`` and a translation ``(3,)``, both arrays or both tensors."""
    xp = _library(linear)  # numpy or torch
    rows = xp.concatenate((linear, origin[:, None]), 1)
    return xp.concatenate((rows, constant([[0.0, 0.0, 0.0, 1.0]], linear)), 0)


def _library(value: Array) -> Any:
    """Return the module of an array, numpy or torch; the functions used here have the same names in both."""
    return torch if isinstance(value, Tensor) else np


def _scaled(vector: Array) -> Array:
    """Divide a vector by its largest entry, taken without gradient; 0 stays 0."""
    largest = abs(vector).max()
    if isinstance(largest, Tensor):
        largest = largest.detach()
    return vector / largest if largest > 0 else vector


def _unit(vector: Array) -> Array:
    """Normalize a vector other than 0."""
    scaled = _scaled(vector)
    return scaled / _library(vector).linalg.norm(scaled)


def _is_number(value: Any) -> bool:
    """Return True for a number of Python or numpy; a bool is none."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def _vector(
    value: Any, key: str, device: Device, expected: str = "three finite numbers [x, y, z]", spread: bool = False
) -> Array:
    """Return three numbers; with ``spread`` one stands for all three. ``key`` and ``expected`` are words of the error."""
    if device is not None:
        return tensor_of(value, device).expand(3)
    items = [value] * 3 if spread and _is_number(value) else value
    if not isinstance(items, Sequence | np.ndarray) or isinstance(items, str) or len(items) != 3:
        raise SceneError(key, value, expected)
    if not all(_is_number(item) for item in items):
        raise SceneError(key, value, expected)
    vector = np.array([_float(item) for item in items])
    if not np.isfinite(vector).all():
        raise SceneError(key, value, expected)
    return vector


def _float(value: Any) -> float:
    """Return a number as a float, inf for an integer beyond float64."""
    try:
        return float(value)
    except OverflowError:
        return float("inf")


def uv_matrix(
    scale: tuple[float, float], degrees: float, translate: tuple[float, float], repeats: tuple[float, float]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the affine map ``(2, 3)`` of texture coordinates: scale, turn from u to v, translate, multiply by ``repeats``."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    if degrees % 90.0 == 0.0:
        c, s = float(round(c)), float(round(s))
    (a, b), (x, y) = scale, repeats
    return (x * c * a, -x * s * b, x * translate[0]), (y * s * a, y * c * b, y * translate[1])


def is_singular(matrix: Matrix) -> bool:
    """Return True if a ``(4, 4)`` matrix is not finite or its linear part has no usable inverse, whatever its scale."""
    linear = np.asarray(matrix)[:3, :3]
    if not np.isfinite(matrix).all():
        return True
    values = np.linalg.svd(linear, compute_uv=False)
    return bool(values[2] <= _SINGULAR * values[0])


def is_usable(matrix: Matrix) -> bool:
    """Return True if a ``(4, 4)`` affine matrix and its inverse exist and are finite in float32."""
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
    """Return True if the linear part of a ``(4, 4)`` matrix keeps lengths: a rotation or reflection."""
    linear = matrix[:3, :3]
    return bool(np.abs(linear.T @ linear - np.eye(3)).max() <= tolerance)


def similarity_scale(matrix: Matrix, tolerance: float = 1e-5) -> float | None:
    """Return the scale of a ``(4, 4)`` similarity (rotation or reflection, translation, uniform scale); None if it is none."""
    values = np.linalg.svd(np.asarray(matrix)[:3, :3], compute_uv=False)
    return float(values.mean()) if values[0] - values[2] <= tolerance * values[0] else None


def apply_points(matrix: Matrix, points: Matrix) -> Matrix:
    """Transform points ``(V, 3)`` by an affine ``(4, 4)`` matrix, in float64."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def translate(offset: Any, key: str = "translate", device: Device = None) -> Array:
    """Return a translation by ``[x, y, z]``."""
    origin = _vector(offset, key, device)
    return affine(constant(np.eye(3), origin), origin)


def scale(factor: Any, key: str = "scale", device: Device = None) -> Array:
    """Return a scale by one number or by ``[x, y, z]``; 0 is an error, as it has no inverse."""
    expected = "a non-zero number or three of them"
    factors = _vector(factor, key, device, expected, spread=True)
    if not factors.all():
        raise SceneError(key, factor, expected)
    xp = _library(factors)
    return affine(xp.diag(factors), xp.zeros_like(factors))


def rotate(argument: Any, key: str = "rotate", device: Device = None) -> Array:
    """Return a rotation ``{axis: [x, y, z], angle: degrees}``, counter-clockwise about the axis (Rodrigues' formula)."""
    _check_keys(argument, ("axis", "angle"), key)
    axis = _vector(argument["axis"], f"{key}.axis", device, "a non-zero axis [x, y, z]")
    if not axis.any():
        raise SceneError(f"{key}.axis", argument["axis"], "a non-zero axis [x, y, z]")
    angle = argument["angle"]
    if device is not None:
        angle = tensor_of(angle, device)
    elif not _is_number(angle) or not np.isfinite(_float(angle)):
        raise SceneError(f"{key}.angle", angle, "a finite number of degrees")
    else:
        angle = _float(angle)
    xp = _library(axis)
    x, y, z = _unit(axis)
    none = xp.zeros_like(x)
    cross = xp.stack((none, -z, y, z, none, -x, -y, x, none)).reshape(3, 3)
    turn = xp.deg2rad(angle % 360.0)
    turned = xp.sin(turn) * cross + (1.0 - xp.cos(turn)) * (cross @ cross)
    return affine(constant(np.eye(3), axis) + turned, xp.zeros_like(axis))


def matrix4(rows: Any, key: str = "matrix", device: Device = None) -> Array:
    """Return an affine ``(4, 4)`` matrix from four rows of four numbers, the last one ``[0, 0, 0, 1]``."""
    if device is not None:
        matrix = tensor_of(rows, device)
        return affine(matrix[:3, :3], matrix[:3, 3])  # the last row is constant
    expected = "four rows of four finite numbers, the last one [0, 0, 0, 1]"
    try:
        entries = [list(row) for row in rows]
    except TypeError:
        raise SceneError(key, rows, expected) from None
    if len(entries) != 4 or any(len(row) != 4 or not all(_is_number(item) for item in row) for row in entries):
        raise SceneError(key, rows, expected)
    matrix = np.array([[_float(item) for item in row] for row in entries])
    if not np.isfinite(matrix).all() or not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise SceneError(key, rows, expected)
    if is_singular(matrix):
        raise SceneError(key, rows, "a matrix with an inverse")
    return matrix


def look_at(origin: Any, target: Any, up: Any = (0.0, 1.0, 0.0), key: str = "look_at", device: Device = None) -> Array:
    """Return the frame at ``origin`` whose +z points to ``target``, with ``up`` in its yz half-plane (as Mitsuba's look_at).

    Errors name ``key.target`` or the like; with an empty ``key``, ``target``.

    Raises:
        SceneError: ``target`` coincides with ``origin``, or ``up`` is zero or parallel to the viewing direction.
    """
    eye, goal = _vector(origin, _join(key, "origin"), device), _vector(target, _join(key, "target"), device)
    above = _vector(up, _join(key, "up"), device)
    away = goal - eye
    if not away.any():
        raise SceneError(
            _join(key, "target"), target, "a point other than the origin (to the 16 digits that numbers keep)"
        )
    xp, direction = _library(eye), _unit(away)
    left = xp.linalg.cross(_scaled(above), direction)
    length = xp.linalg.norm(left)
    if length <= _PARALLEL:
        raise SceneError(_join(key, "up"), up, "a direction that is not parallel to target - origin")
    left = left / length
    return affine(xp.stack((left, xp.linalg.cross(direction, left), direction), 1), eye)


def _look_at_operation(argument: Any, key: str, device: Device) -> Array:
    """Return :func:`look_at` for a mapping of its arguments."""
    _check_keys(argument, ("origin", "target", "up"), key, optional=("up",))
    return look_at(argument["origin"], argument["target"], argument.get("up", (0.0, 1.0, 0.0)), key, device)


#: The operations of a transform list, by name: ``(argument, key, device) -> (4, 4)``.
OPERATIONS: dict[str, Callable[[Any, str, Device], Array]] = {
    "translate": translate,
    "scale": scale,
    "rotate": rotate,
    "matrix": matrix4,
    "look_at": _look_at_operation,
}


def compose(operations: Any, device: Device = None) -> Array:
    """Return one ``(4, 4)`` matrix from a list of single-key mappings, applied in the order listed.

    Args:
        operations: e.g. ``[{"scale": 2}, {"rotate": {"axis": [0, 1, 0], "angle": 30}}, {"translate": [0, 1, 0]}]``.
        device: None: return an array; else a float64 tensor there, of operations that were checked before.

    Raises:
        SceneError: an entry is malformed or singular (its ``key`` is relative to the list, e.g. ``1.rotate.axis``), or the
            product or its inverse overflows float32 (the ``key`` is empty).
    """
    names = ", ".join(OPERATIONS)
    if not isinstance(operations, list | tuple):
        raise SceneError("", operations, f"a list of {names}, each like {{translate: [0, 1, 0]}}")
    total: Array = np.eye(4) if device is None else torch.eye(4, dtype=torch.float64, device=device)
    for index, entry in enumerate(operations):
        if not isinstance(entry, Mapping) or len(entry) != 1:
            raise SceneError(str(index), entry, f"a mapping with one of the operations {names}")
        ((name, argument),) = entry.items()
        if name not in OPERATIONS:
            raise SceneError(f"{index}.{name}", argument, f"one of the operations {names}")
        with np.errstate(over="ignore", invalid="ignore"):
            total = OPERATIONS[name](argument, f"{index}.{name}", device) @ total
    if device is None and not is_usable(total):
        raise SceneError("", operations, f"operations whose product can be inverted, {FINITE_WORDS}")
    return total


def _check_keys(argument: Any, keys: tuple[str, ...], key: str, optional: tuple[str, ...] = ()) -> None:
    """Refuse an argument that is no mapping with these keys; ``key`` is its own dotted key, for errors."""
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
    """Return ``key.name``, or the name alone where the key is empty."""
    return f"{key}.{name}" if key else name
