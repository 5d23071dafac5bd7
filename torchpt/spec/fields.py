"""Field types of the scene format: each takes plain YAML values, and says what it accepts when it refuses one.

Numbers are strict: no booleans, no numeric text, nothing that is not finite in float32.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from itertools import chain
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic_core import PydanticCustomError

from torchpt.errors import SceneError
from torchpt.math import transforms
from torchpt.spec.validate import Check

__all__ = [
    "Affine", "Check", "Color", "FaceArray", "Flag", "Rows2", "Rows3", "Text", "Transform", "Vec3",
    "bounded", "choice", "color", "file_paths", "integer", "memory_size",
    "number", "number_field", "pair", "scalar", "vector", "wrong",
]  # fmt: skip


_LARGEST = float(np.finfo(np.float32).max)
_OR_TEXTURE = ", or a texture"


def wrong(
    expected: str, value: Any = ..., at: tuple[str | int, ...] = (), *, not_built: bool = False
) -> PydanticCustomError:
    """The error of a field validator: what is accepted, and (where it lies deeper) which value under which sub-key."""
    return PydanticCustomError(
        "scene", "refused", {"expected": expected, "value": value, "at": at, "not_built": not_built}
    )


def number(value: Any, expected: str = "a finite number") -> float:
    """A finite float from an int or float (numpy's too), never from a boolean or text."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, int | float | np.integer | np.floating):
        raise wrong(expected)
    if not -_LARGEST <= value <= _LARGEST:  # false for NaN too
        raise wrong(expected)
    return float(value)


def number_field(expected: str, accept: Callable[[float], bool] = lambda _: True, *, optional: bool = False) -> Check:
    """A validator for one number that ``accept`` allows; with ``optional`` None stays None."""

    def check(value: Any) -> float | None:
        if value is None and optional:
            return None
        result = number(value, expected)
        if not accept(result):
            raise wrong(expected)
        return result

    return Check(check)


def integer(low: int, high: int, *, also: tuple[Any, ...] = ()) -> Check:
    """A validator for a whole number in ``low..high``, or one of the values in ``also``."""
    words = "".join(f" or {'null' if item is None else item}" for item in also)
    expected = f"a whole number {low}..{high}{words}"

    def check(value: Any) -> Any:
        if isinstance(value, bool | np.bool_):
            raise wrong(expected)
        if (value is None or isinstance(value, int | str)) and value in also:
            return value
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if not isinstance(value, int | np.integer) or not low <= value <= high:
            raise wrong(expected)
        return int(value)

    return Check(check)


def choice(*names: str, booleans: Mapping[bool, str] | None = None) -> Check:
    """A validator for one of some words; ``booleans`` says which word a YAML boolean stands for."""
    expected = f"one of {', '.join(names)}"

    def check(value: Any) -> str:
        if booleans is not None and isinstance(value, bool):
            value = booleans[value]
        if not isinstance(value, str) or value not in names:
            raise wrong(expected)
        return value

    return Check(check)


def vector(value: Any, expected: str = "three finite numbers [x, y, z]") -> tuple[float, float, float]:
    """Three finite numbers from a list, tuple or array."""
    if not isinstance(value, list | tuple | np.ndarray) or len(value) != 3:
        raise wrong(expected)
    x, y, z = (number(item, expected) for item in value)
    return x, y, z


def pair(expected: str, *, single: bool = False) -> Check:
    """A validator for two finite numbers; with ``single`` one number stands for both."""

    def check(value: Any) -> tuple[float, float]:
        if single and not isinstance(value, list | tuple | np.ndarray):
            value = (value, value)
        if not isinstance(value, list | tuple | np.ndarray) or len(value) != 2:
            raise wrong(expected)
        return number(value[0], expected), number(value[1], expected)

    return Check(check)


def bounded(value: Any, low: float, high: float, expected: str) -> float:
    """A finite float in ``low..high``."""
    result = number(value, expected)
    if not low <= result <= high:
        raise wrong(expected)
    return result


def scalar(low: float | None = 0.0, high: float = _LARGEST, *, optional: bool = False, texture: bool = False) -> Check:
    """A validator for a number in ``low..high`` (any, where ``low`` is None), or a texture that gives it."""
    floor = -_LARGEST if low is None else low
    expected = f"a finite number{_bound(low, high)}{_OR_TEXTURE if texture else ''}"

    def check(value: Any) -> Any:
        if value is None and optional:
            return None
        if texture and isinstance(value, Mapping):
            return _slot(value, False, floor, high)
        return bounded(value, floor, high, expected)

    return Check(check)


def color(low: float | None = 0.0, high: float = _LARGEST, *, optional: bool = False, texture: bool = False) -> Check:
    """A validator for a linear RGB colour: three numbers or one for all, each in ``low..high``, or a texture."""
    floor = -_LARGEST if low is None else low
    bound = _bound(low, high)
    expected = f"[r, g, b] or one number, each finite{' and' if bound else ''}{bound}{_OR_TEXTURE if texture else ''}"

    def check(value: Any) -> Any:
        if value is None and optional:
            return None
        if texture and isinstance(value, Mapping):
            return _slot(value, True, floor, high)
        if isinstance(value, list | tuple | np.ndarray):
            rgb = vector(value, expected)
        else:
            gray = number(value, expected)
            rgb = (gray, gray, gray)
        if not all(floor <= channel <= high for channel in rgb):
            raise wrong(expected)
        return rgb

    return Check(check)


def _bound(low: float | None, high: float) -> str:
    if low is None:
        return ""
    return f" in {low:g}..{high:g}" if high < _LARGEST else f" >= {low:g}"


def _slot(value: Mapping[str, Any], coloured: bool, low: float, high: float) -> Any:
    from torchpt.format.textures import texture_input  # whose own fields are of these types

    return texture_input(value, coloured, low, high)


def file_paths(value: Any) -> tuple[str, ...]:
    """One file path, or a list of candidates of which the first existing one is used."""
    paths = tuple(value) if isinstance(value, list | tuple) else (value,)
    if not paths or not all(isinstance(path, str) and path.strip() and path.isprintable() for path in paths):
        raise wrong("a file path, or a list of them (the first that is there is used)")
    return paths


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise wrong("true or false")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise wrong("printable text")
    return value


def _relocated(error: SceneError) -> PydanticCustomError:
    at = tuple(part for part in error.key.split(".") if part)
    return wrong(error.expected, error.value, at)


def _transform(value: Any) -> NDArray[np.float64]:
    try:
        return transforms.compose(value)
    except SceneError as error:
        raise _relocated(error) from None


def _affine(value: Any) -> NDArray[np.float64] | None:
    if value is None:
        return None
    try:
        matrix = transforms.matrix4(value, "")
    except SceneError as error:
        raise _relocated(error) from None
    if not transforms.is_usable(matrix):
        raise wrong(f"a matrix that can be inverted, {transforms.WITHIN}")
    return matrix


def _rows(columns: int, what: str) -> Check:
    """A validator for ``(V, columns)`` float64 from nested lists or an array; checked and converted in bulk."""
    expected = f"a list of {what}, finite numbers each"

    def check(value: Any) -> NDArray[np.float64] | None:
        if value is None:
            return None
        if isinstance(value, list | tuple):
            if not value or not set(map(type, value)) <= {list, tuple} or set(map(len, value)) != {columns}:
                _first_bad(value, columns, expected)
                raise wrong(expected)
            if not set(map(type, chain.from_iterable(value))) <= {int, float}:
                _first_bad(value, columns, expected)
        try:
            rows = np.array(value, dtype=np.float64)
        except (OverflowError, TypeError, ValueError, RuntimeError):
            raise wrong(expected) from None
        if isinstance(value, np.ndarray) and value.dtype.kind not in "iuf":
            raise wrong(expected, value.dtype)
        if rows.ndim != 2 or rows.shape[1] != columns or not len(rows):
            raise wrong(expected)
        bad = np.flatnonzero(~(np.abs(rows) <= _LARGEST).all(axis=1))
        if len(bad):
            raise wrong(expected, rows[bad[0]].tolist(), (int(bad[0]),))
        return rows

    return Check(check)


def _first_bad(value: Any, columns: int, expected: str) -> None:
    """Raises for the first row of a list that is not ``columns`` numbers."""
    for index, row in enumerate(value):
        if not isinstance(row, list | tuple) or len(row) != columns or not all(type(x) in (int, float) for x in row):
            raise wrong(expected, row, (index,))


def _faces(value: Any) -> NDArray[np.int64] | None:
    """``(F, 3)`` int64 from lists of three or more indices; polygons are split into fans."""
    expected = "a list of faces, each three or more vertex indices (whole numbers >= 0)"
    if value is None:
        return None
    if isinstance(value, list | tuple):
        lists = bool(value) and set(map(type, value)) <= {list, tuple}
        if not lists or set(map(type, chain.from_iterable(value))) != {int} or min(map(len, value)) < 3:
            for index, row in enumerate(value):
                if not isinstance(row, list | tuple) or len(row) < 3 or not all(type(x) is int for x in row):
                    raise wrong(expected, row, (index,))
            raise wrong(expected)
        triangles: Any = value
        if max(map(len, value)) > 3:
            triangles = [(row[0], row[i], row[i + 1]) for row in value for i in range(1, len(row) - 1)]
    else:
        triangles = value
    try:
        faces = np.array(triangles)
    except (OverflowError, TypeError, ValueError, RuntimeError):
        raise wrong(expected) from None
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or faces.dtype.kind not in "iu":
        raise wrong(expected)
    return faces.astype(np.int64)


_SIZE = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([kKMGT]?)(i?)[bB]?\s*\Z")


def memory_size(value: Any) -> int | None:
    """Bytes from a whole number or text such as ``4GB`` (10^9) or ``512 MiB`` (2^20)."""
    expected = "null, a number of bytes, or a size such as 4GB or 512MiB"
    if value is None:
        return None
    if isinstance(value, str):
        match = _SIZE.match(value)
        if not match:
            raise wrong(expected)
        base = 1024 if match[3] else 1000
        value = int(float(match[1]) * base ** " KMGT".index(match[2].upper() or " "))
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 2**60:
        raise wrong(expected)
    return value


Vec3 = Annotated[tuple[float, float, float], Check(lambda value: vector(value))]
Color = Annotated[tuple[float, float, float], color()]
Flag = Annotated[bool, Check(_flag)]
Text = Annotated[str, Check(_text)]
Transform = Annotated[NDArray[np.float64], Check(_transform)]
Affine = Annotated[NDArray[np.float64] | None, Check(_affine)]
Rows3 = Annotated[NDArray[np.float64] | None, _rows(3, "[x, y, z]")]
Rows2 = Annotated[NDArray[np.float64] | None, _rows(2, "[u, v]")]
FaceArray = Annotated[NDArray[np.int64] | None, Check(_faces)]
