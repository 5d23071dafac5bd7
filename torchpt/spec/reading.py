"""Read plain values: each function checks and converts a value from a file or a caller, or raises :class:`Refused`.

Numbers are strict: no booleans, no numeric text, nothing that is not finite in float32.
"""

from __future__ import annotations

import math
import re
from itertools import chain
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.math import transforms

__all__ = [
    "LARGEST",
    "Refused",
    "as_refused",
    "bounded",
    "faces",
    "file_paths",
    "flag",
    "matrix",
    "memory_size",
    "number",
    "pair",
    "rows",
    "text",
    "transform",
    "vector",
]  # fmt: skip

#: Largest number of float32.
LARGEST = float(np.finfo(np.float32).max)


class Refused(ValueError):
    """A value that is not accepted.

    Attributes:
        expected: phrase of what is accepted.
        value: the element that is wrong; ``...``: the whole value.
        at: keys and indices that lead to that element.
    """

    def __init__(self, expected: str, value: Any = ..., at: tuple[str | int, ...] = ()) -> None:
        self.expected, self.value, self.at = expected, value, at
        super().__init__(expected)


def as_refused(error: SceneError) -> Refused:
    """Return a :class:`Refused` for an error whose key is relative to the value that is read."""
    return Refused(error.expected, error.value, at=tuple(part for part in error.key.split(".") if part))


def number(value: Any, expected: str = "a finite number") -> float:
    """Return a finite float from an int or float (numpy's too), never from a boolean or text."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise Refused(expected)
    if not -LARGEST <= value <= LARGEST:  # false for NaN too
        raise Refused(expected)
    return float(value)


def vector(value: Any, expected: str = "three finite numbers [x, y, z]") -> tuple[float, float, float]:
    """Return three finite numbers from a list, tuple or array."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 3:
        raise Refused(expected)
    x, y, z = (number(item, expected) for item in value)
    return x, y, z


def bounded(value: Any, low: float, high: float, expected: str) -> float:
    """Return a finite float in ``low..high``."""
    result = number(value, expected)
    if not low <= result <= high:
        raise Refused(expected)
    return result


def pair(value: Any, expected: str, *, single: bool = False) -> tuple[float, float]:
    """Return two finite numbers; with ``single`` one number may stand for both."""
    if single and not isinstance(value, list | tuple | np.ndarray):
        value = (value, value)
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
        raise Refused(expected)
    return number(value[0], expected), number(value[1], expected)


def file_paths(value: Any) -> tuple[str, ...]:
    """Return file paths, from one path or a list of candidates of which the first that exists is to be used."""
    paths = tuple(value) if isinstance(value, list | tuple) else (value,)
    if not paths or not all(isinstance(path, str) and path.strip() and path.isprintable() for path in paths):
        raise Refused("a file path, or a list of them (the first that is there is used)")
    return paths


def flag(value: Any) -> bool:
    """Return a boolean."""
    if not isinstance(value, bool):
        raise Refused("true or false")
    return value


def text(value: Any) -> str:
    """Return a line of text that is not blank."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise Refused("printable text")
    return value


def transform(value: Any, device: torch.device | None = None) -> Any:
    """Return the ``(4, 4)`` of a matrix or of a list of operations as in :func:`torchpt.math.transforms.compose`.

    Args:
        value: the matrix or the list as written.
        device: device of a float64 tensor, to which gradients of tensors in ``value`` flow; None: an array.
    """
    row_types = list | np.ndarray | Tensor
    is_nested = isinstance(value, list) and value and isinstance(value[0], row_types)
    if isinstance(value, np.ndarray | Tensor) or is_nested:
        return matrix(value) if device is None else transforms.matrix4(value, "", device)
    try:
        return transforms.compose(value, device)
    except SceneError as error:
        raise as_refused(error) from None


def matrix(value: Any) -> NDArray[np.float64]:
    """Return an affine ``(4, 4)`` matrix that can be inverted."""
    try:
        found = transforms.matrix4(value, "")
    except SceneError as error:
        raise as_refused(error) from None
    if not transforms.is_usable(found):
        raise Refused(f"a matrix that can be inverted, {transforms.FINITE_WORDS}")
    return found


def rows(value: Any, columns: int, what: str) -> NDArray[np.float64]:
    """Return ``(V, columns)`` float64 from nested lists or an array, checked and converted in bulk.

    Args:
        value: the rows as written.
        columns: numbers of a row.
        what: a row in the words of errors, such as ``[x, y, z]``.
    """
    expected = f"a list of {what}, finite numbers each"
    if isinstance(value, list | tuple):
        if not value or not set(map(type, value)) <= {list, tuple} or set(map(len, value)) != {columns}:
            _refuse_first_bad_row(value, columns, expected)
            raise Refused(expected)
        if not all(map(_is_number, set(map(type, chain.from_iterable(value))))):
            _refuse_first_bad_row(value, columns, expected)
    try:
        found = np.array(value, dtype=np.float64)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise Refused(expected) from None
    if isinstance(value, np.ndarray) and value.dtype.kind not in "iuf":  # integers and floats
        raise Refused(expected, value.dtype)
    if found.ndim != 2 or found.shape[1] != columns or not len(found):
        raise Refused(expected)
    bad = np.flatnonzero(~(np.abs(found) <= LARGEST).all(axis=1))
    if len(bad):
        raise Refused(expected, found[bad[0]].tolist(), at=(int(bad[0]),))
    return found


def _refuse_first_bad_row(value: Any, columns: int, expected: str) -> None:
    """Raise for the first row of a list that is not ``columns`` numbers."""
    for index, row in enumerate(value):
        if not isinstance(row, list | tuple) or len(row) != columns or not all(_is_number(type(x)) for x in row):
            raise Refused(expected, row, at=(index,))


def _is_number(kind: type) -> bool:
    """Return True for types of numbers, numpy's included, other than bool."""
    return kind is not bool and issubclass(kind, int | float | np.integer | np.floating)


def faces(value: Any) -> NDArray[np.int64]:
    """Return triangles ``(F, 3)`` int64 from lists of three or more indices; polygons are split into fans.

    Indices out of range, negative ones among them, are refused where the number of vertices is known.
    """
    expected = "a list of faces, each three or more vertex indices (whole numbers >= 0)"
    if isinstance(value, list | tuple):
        all_lists = bool(value) and set(map(type, value)) <= {list, tuple}
        if not all_lists or set(map(type, chain.from_iterable(value))) != {int} or min(map(len, value)) < 3:
            for index, row in enumerate(value):
                if not isinstance(row, list | tuple) or len(row) < 3 or not all(type(x) is int for x in row):
                    raise Refused(expected, row, at=(index,))
            raise Refused(expected)
        triangles: Any = value
        if max(map(len, value)) > 3:
            triangles = [(row[0], row[i], row[i + 1]) for row in value for i in range(1, len(row) - 1)]
    else:
        triangles = value
    try:
        found = np.array(triangles)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise Refused(expected) from None
    if found.ndim != 2 or found.shape[1] != 3 or not len(found) or found.dtype.kind not in "iu":
        raise Refused(expected)
    return found.astype(np.int64)


# A number, a decimal prefix (k K M G T), `i` for a binary one, `b` or `B`: 4GB, 512 MiB, 1.5g is refused.
_MEMORY_SIZE = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([kKMGT]?)(i?)[bB]?\s*\Z")


def memory_size(value: Any) -> int | None:
    """Return bytes from a whole number or text such as ``4GB`` (10^9) or ``512 MiB`` (2^20); None for None."""
    expected = "null, a number of bytes, or a size such as 4GB or 512MiB"
    if value is None:
        return None
    if isinstance(value, str):
        match = _MEMORY_SIZE.match(value)
        if not match:
            raise Refused(expected)
        base = 1024 if match[3] else 1000
        digits, prefix, _ = match.groups()
        size = float(digits) * base ** " KMGT".index(prefix.upper() or " ")  # the exponent is the prefix's index
        value = int(size) if math.isfinite(size) else None
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 2**60:  # an EiB
        raise Refused(expected)
    return value
