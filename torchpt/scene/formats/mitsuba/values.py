"""Read the values of Mitsuba's XML: numbers, colours, spectra, transforms.

Colours become linear sRGB, as in Mitsuba's ``rgb`` variants: a spectrum of a reflectance is seen under D65 light, that of an
emitter as it is (an equal energy spectrum of 1 is then ``[1.205, 0.948, 0.909]``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.core.errors import SceneError
from torchpt.core.files import read_regular
from torchpt.images.colour import srgb_to_linear
from torchpt.math import transforms
from torchpt.math.vectors import Frame
from torchpt.scene.formats.mitsuba.cie import D65, WAVELENGTHS, XYZ
from torchpt.scene.formats.mitsuba.elements import Element

__all__ = ["LARGEST", "boolean", "colour", "integer", "is_projective", "number", "numbers", "transform", "vector"]

Rgb = tuple[float, float, float]
Matrix = NDArray[np.float64]
#: Finds a file by its name: ``(element, name) -> path``, or None where a missing file is only a warning.
FindFile = Callable[[Element, str], Path | None]

#: Largest magnitude of a number: float32's.
LARGEST = float(np.finfo(np.float32).max)
#: From XYZ to linear sRGB (ITU-R BT.709, D65), to the six digits that Mitsuba has.
_TO_SRGB = np.array(
    [[3.240479, -1.537150, -0.498535], [-0.969256, 1.875991, 0.041556], [0.055648, -0.204043, 1.057311]]
)
# The tables at the wavelengths where Mitsuba sums spectra up, half a nanometre apart; between their points they are linear.
_FINE = np.linspace(WAVELENGTHS[0], WAVELENGTHS[-1], 1000)
_OBSERVER = np.stack([np.interp(_FINE, WAVELENGTHS, row) for row in XYZ])
_DAYLIGHT = np.interp(_FINE, WAVELENGTHS, D65)
_HEX = re.compile(r"#[0-9a-fA-F]{6}\Z")


def numbers(element: Element, text: str, counts: Sequence[int] = ()) -> list[float]:
    """Return the numbers of a text, between blanks or commas.

    Args:
        element: the element, for errors.
        text: the text.
        counts: how many there may be; empty: any number but none.

    Raises:
        SceneError: no numbers, or not as many.
    """
    words = text.replace(",", " ").split()
    try:
        found = [float(word) for word in words]
    except ValueError:
        raise element.error(text, "numbers between blanks or commas") from None
    if not found or (counts and len(found) not in counts):
        words = " or ".join(map(str, counts)) or "some"
        raise element.error(text, f"{words} number{'' if words == '1' else 's'}")
    if not all(abs(value) <= LARGEST for value in found):  # false for NaN
        raise element.error(text, "finite numbers")
    return found


def number(element: Element, text: str) -> float:
    """Return one number."""
    return numbers(element, text, (1,))[0]


def integer(element: Element, text: str) -> int:
    """Return a whole number."""
    value = number(element, text)
    if not value.is_integer():
        raise element.error(text, "a whole number")
    return int(value)


def boolean(element: Element, text: str) -> bool:
    """Return a boolean."""
    if text.strip().lower() not in ("true", "false"):
        raise element.error(text, "true or false")
    return text.strip().lower() == "true"


def vector(element: Element, default: float = 0.0) -> list[float]:
    """Return the three numbers of a ``<point>``, a ``<vector>`` or an operation: ``value``, or ``x y z``."""
    attributes = element.attributes
    if "value" in attributes:
        found = numbers(element, attributes["value"], (1, 3))
        return found * 3 if len(found) == 1 else found
    return [number(element, attributes[axis]) if axis in attributes else default for axis in "xyz"]


# ---- Colours


def colour(element: Element, *, light: bool, find: FindFile) -> Rgb:
    """Return the linear sRGB colour of an ``<rgb>``, ``<srgb>``, ``<color>``, ``<spectrum>``, ``<blackbody>`` or ``<float>``.

    Args:
        element: the element.
        light: True for the colour of a light, False for a reflectance or another factor.
        find: finds the file of a spectrum.

    Raises:
        SceneError: a value that is no colour.
    """
    if element.tag == "blackbody" or (element.tag == "spectrum" and element.type == "blackbody"):
        return _blackbody(element)
    if element.tag == "spectrum":
        return _spectrum(element, light=light, find=find)
    text = element.attributes.get("value", "").strip()
    if _HEX.match(text):
        value = np.array([int(text[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
        # Before version 2 Mitsuba took those of <rgb> as linear.
        return _rgb(value if element.tag == "rgb" and element.version < (2,) else _decoded(value))
    found = np.array(numbers(element, text, (1, 3)))
    found = np.broadcast_to(found, 3)
    return _rgb(_decoded(found) if element.tag == "srgb" else found)


def _rgb(values: Matrix) -> Rgb:
    r, g, b = (float(value) for value in values)
    return r, g, b


def _decoded(values: Matrix) -> Matrix:
    """Decode sRGB (IEC 61966-2-1)."""
    return srgb_to_linear(torch.from_numpy(np.maximum(values, 0.0))).numpy()


def _spectrum(element: Element, *, light: bool, find: FindFile) -> Rgb:
    """Return the colour of a ``<spectrum>``: one number, ``wavelength:value`` pairs, values at even steps, or a file."""
    attributes = {
        **{_name(child): child.attributes.get("value", "") for child in element.children},
        **element.attributes,
    }
    if element.type in ("d65", "uniform", "srgb", "rgb"):
        found = numbers(element, attributes.get("color") or attributes.get("value") or "1", (1, 3))
        scale = number(element, attributes.get("scale") or "1")
        return _rgb(np.broadcast_to(np.array(found) * scale, 3))
    if "filename" in attributes:
        path = find(element, attributes["filename"])
        if path is None:
            return 0.5, 0.5, 0.5
        wavelengths, values = _spectrum_file(element, path)
    elif "values" in attributes:
        values = np.array(numbers(element, attributes["values"]))
        if "wavelengths" in attributes:
            wavelengths = np.array(numbers(element, attributes["wavelengths"]))
        else:
            ends = [number(element, attributes.get(key, "")) for key in _ENDS if key in attributes]
            if len(ends) != 2:
                raise element.error(
                    attributes["values"], "values with wavelengths, or wavelength_min and wavelength_max"
                )
            wavelengths = np.linspace(ends[0], ends[1], len(values))
    else:
        text = attributes.get("value", "").strip()
        if _HEX.match(text):
            return colour(_as_rgb(element, text), light=light, find=find)
        if ":" not in text:
            # Before version 2 light of one number was white.
            return _rgb(_flat(np.array(numbers(element, text, (1, 3))), light=light and element.version >= (2,)))
        pairs = [numbers(element, pair.replace(":", " "), (2,)) for pair in text.replace(",", " ").split()]
        wavelengths, values = np.array(pairs).T
    if len(wavelengths) != len(values) or (np.diff(wavelengths) <= 0).any() or not len(values):
        raise element.error(element.attributes.get("value", element.label), "values at wavelengths that grow")
    return _rgb(_seen(np.interp(_FINE, wavelengths, values, left=0.0, right=0.0), light=light))


_ENDS = ("wavelength_min", "wavelength_max")


def _name(element: Element) -> str:
    name = element.attributes.get("name", "")
    end = {"lambdaMin": 0, "lambda_min": 0, "lambdaMax": 1, "lambda_max": 1}.get(name)
    return name if end is None else _ENDS[end]


def _as_rgb(element: Element, text: str) -> Element:
    return Element("rgb", {"value": text}, element.file, element.line, element.folder, element.version)


def _flat(values: Matrix, *, light: bool) -> Matrix:
    """Return the colour of a constant spectrum; three numbers are taken as a colour."""
    if len(values) == 3 or not light:
        return np.broadcast_to(values, 3)
    return values * _seen(np.ones_like(_FINE), light=True)


def _seen(values: Matrix, *, light: bool) -> Matrix:
    """Return the linear sRGB colour of a spectrum at the wavelengths ``_FINE``; negative components become 0."""
    weights = np.ones_like(_FINE) if light else _DAYLIGHT
    xyz = (_OBSERVER * (weights * values)).sum(1) / (_OBSERVER[1] * weights).sum()
    return np.maximum(_TO_SRGB @ xyz, 0.0)


def _spectrum_file(element: Element, path: Path) -> tuple[Matrix, Matrix]:
    """Return wavelengths and values of a text file with a pair on each line; ``#`` begins a comment."""
    try:
        text = read_regular(path, 2**24).decode("utf-8", "replace")
    except OSError as error:
        raise element.error(str(path), f"a file of wavelengths and values ({error.strerror})") from None
    rows = [line.partition("#")[0].strip() for line in text.splitlines()]
    pairs = [numbers(element, row, (2,)) for row in rows if row]
    if not pairs:
        raise element.error(str(path), "a file of wavelengths and values, a pair on each line")
    wavelengths, values = np.array(pairs).T
    return wavelengths, values


def _blackbody(element: Element) -> Rgb:
    """Return the radiance of a black body, in W / (m^2 sr nm) before it is seen (Planck's law)."""
    attributes = {**{child.attributes.get("name", ""): child.attributes.get("value", "") for child in element.children}}
    attributes |= element.attributes
    kelvin = number(element, attributes.get("temperature", "").strip().rstrip("kK"))
    scale = number(element, attributes.get("scale") or attributes.get("multiplier") or "1")
    if not kelvin > 0.0:
        raise element.error(kelvin, "a temperature in kelvin > 0")
    metres = _FINE * 1e-9
    h, c, k = 6.62607015e-34, 299792458.0, 1.380649e-23
    with np.errstate(over="ignore"):
        radiance = 2.0 * h * c * c / metres**5 / np.expm1(np.minimum(h * c / (metres * k * kelvin), 700.0)) * 1e-9
    return _rgb(scale * _seen(radiance, light=True))


# ---- Transforms


def transform(element: Element) -> Matrix:
    """Return the matrix ``(4, 4)`` of a ``<transform>``: its operations, applied in the order listed.

    Raises:
        SceneError: an unknown operation, or one without meaning.
    """
    total = np.eye(4)
    for child in element.children:
        if child.tag == "transform":
            step = transform(child)
        elif child.tag in _OPERATIONS:
            step = _operation(child)
        else:
            expected = f"one of {', '.join(_OPERATIONS)} inside a transform"
            raise child.error(f"<{child.written}>", expected)
        total = step @ total
    if not np.isfinite(total).all() or np.abs(total).max() > LARGEST:
        raise element.error(element.attributes.get("name", "transform"), "a transform of finite numbers")
    return total


def _operation(element: Element) -> Matrix:
    try:
        return _OPERATIONS[element.tag](element)
    except SceneError as error:
        if error.file is not None:
            raise
        raise element.error(error.value, error.expected) from None


def _translate(element: Element) -> Matrix:
    _check_given(element)
    total = np.eye(4)
    total[:3, 3] = vector(element)
    return total


def _scale(element: Element) -> Matrix:
    _check_given(element)
    return np.diag([*vector(element, default=1.0), 1.0])


def _check_given(element: Element) -> None:
    """Refuse an operation none of whose attributes is one that it has; without any it does nothing, as in Mitsuba."""
    if element.attributes and not any(key in element.attributes for key in ("value", *"xyz")):
        raise element.error(f"<{element.written}>", "x, y, z or value")


def _rotate(element: Element) -> Matrix:
    attributes = element.attributes
    if "angle" not in attributes:
        raise element.error("<rotate>", "an attribute angle")
    axis = vector(element)
    if not any(key in attributes for key in ("value", *"xyz")):
        axis = [0.0, 0.0, 1.0]
    return transforms.rotate({"axis": axis, "angle": number(element, attributes["angle"])})


def _matrix(element: Element) -> Matrix:
    values = np.array(numbers(element, element.attributes.get("value", ""), (9, 16)))
    total = np.eye(4)
    if len(values) == 9:
        total[:3, :3] = values.reshape(3, 3)
        return total
    total = values.reshape(4, 4)
    if element.version < (2,) and total[3, 3] != 0.0:  # Mitsuba divided by it then, and takes no notice of it now
        total = total / total[3, 3]
    total[3] = [0.0, 0.0, 0.0, 1.0]
    return total


def is_projective(element: Element) -> bool:
    """Return True for a ``<transform>`` with a ``<matrix>`` in whose last row more than the last number stands."""
    rows = (child.attributes.get("value", "").replace(",", " ").split()[12:15] for child in element.children)
    return any(abs(float(word)) > 1e-6 for row in rows for word in row)


def _look_at(element: Element) -> Matrix:
    attributes = element.attributes
    if "ox" in attributes:  # before 0.3: one attribute for each number, and x mirrored
        attributes = {
            name: " ".join(attributes.get(f"{letter}{axis}", "0") for axis in "xyz")
            for name, letter in (("origin", "o"), ("target", "t"), ("up", "u"))
            if f"{letter}x" in attributes
        }
        mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    else:
        mirror = np.eye(4)
    origin, target = (numbers(element, attributes.get(name, ""), (3,)) for name in ("origin", "target"))
    away = np.subtract(target, origin)
    up = numbers(element, attributes["up"], (3,)) if "up" in attributes else None
    if (up is None or not any(up)) and away.any():
        up = _any_up(away, modern=element.version >= (2,))
    return transforms.look_at(origin, target, up) @ mirror


def _any_up(away: Matrix, *, modern: bool) -> list[float]:
    """Return the direction across ``away`` that Mitsuba takes as up where none is given."""
    away = away / np.abs(away).max()
    away = away / np.linalg.norm(away)
    if modern:
        return Frame.about(torch.from_numpy(away)[:, None]).s[:, 0].tolist()
    x, y, z = away
    across = np.array([z, 0.0, -x]) if abs(x) > abs(y) else np.array([0.0, z, -y])
    return np.cross(across, away).tolist()


_OPERATIONS: dict[str, Callable[[Element], Matrix]] = {
    "translate": _translate,
    "scale": _scale,
    "rotate": _rotate,
    "matrix": _matrix,
    "lookat": _look_at,
}
