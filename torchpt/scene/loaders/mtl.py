"""MTL material files: the diffuse colour `Kd` and the emission `Ke`; what else changes the look is listed by name."""

from __future__ import annotations

import math
from pathlib import Path

from torchpt.errors import AssetError
from torchpt.scene.loaders.mesh_part import FileMaterial, Rgb

__all__ = ["decoded_lines", "read_mtl"]

# keys that change nothing in a path tracer, or nothing without one of the others
_SILENT = {"ka", "map_ka", "ns", "sharpness", "newmtl"}
# what a key says when it asks for nothing
_NEUTRAL = {"ks": 0.0, "d": 1.0, "tr": 0.0, "tf": 1.0, "ni": 1.0, "ps": 0.0, "pm": 0.0, "pc": 0.0}


def decoded_lines(data: bytes) -> list[str]:
    """The lines of a text file, with continuations (a backslash at the end of a line) joined by blanks of equal count.

    A continued line keeps the line numbers right: what was joined leaves empty lines behind.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if "\\" in text:
        for number in range(len(lines) - 2, -1, -1):
            if lines[number].endswith("\\"):
                lines[number] = f"{lines[number][:-1]} {lines[number + 1]}"
                lines[number + 1] = ""
    return lines


def read_mtl(path: Path) -> dict[str, FileMaterial]:
    """The materials of an MTL file by name.

    Raises:
        AssetError: a file that cannot be read, a colour that is malformed or negative.
    """
    try:
        lines = decoded_lines(path.read_bytes())
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    materials: dict[str, FileMaterial] = {}
    name, colors, ignored = "", {}, []

    def finish() -> None:
        if name:
            emission = colors.get("ke")
            emission = emission if emission and any(emission) else None
            materials[name] = FileMaterial(name, colors.get("kd"), emission, tuple(dict.fromkeys(ignored)))

    for number, line in enumerate(lines, 1):
        key, _, rest = line.strip().partition(" ") if " " in line.strip() else line.strip().partition("\t")
        key, _, tail = key.partition("\t")
        rest = f"{tail} {rest}".strip()
        lower = key.lower()
        if not key or key.startswith("#"):
            continue
        if lower == "newmtl":
            finish()
            name, colors, ignored = rest, {}, []
            if not name:
                raise AssetError(path, f"line {number}: newmtl without a name")
        elif lower in ("kd", "ke"):
            if rest.split()[:1] in (["spectral"], ["xyz"]):
                ignored.append(f"{key} {rest.split()[0]}")
                continue
            color = _color(rest, key, path, number)
            if lower == "kd" and max(color) > 1:
                ignored.append("Kd above 1")
                color = (min(color[0], 1.0), min(color[1], 1.0), min(color[2], 1.0))
            colors[lower] = color
        elif lower not in _SILENT and not _is_neutral(lower, rest):
            ignored.append(key)
    finish()
    return materials


def _color(text: str, key: str, path: Path, number: int) -> Rgb:
    try:
        values = [float(word) for word in text.partition("#")[0].split()]
    except ValueError:
        values = []
    if len(values) == 1:
        values *= 3
    if len(values) != 3 or not all(0 <= value <= 3e38 for value in values):
        raise AssetError(path, f"line {number}: expected {key} r g b, finite and >= 0, got {text[:60]!r}")
    return values[0], values[1], values[2]


def _is_neutral(key: str, text: str) -> bool:
    """Whether a key of the file asks for nothing."""
    try:
        values = [float(word) for word in text.partition("#")[0].split()]
    except ValueError:
        return False
    if key == "illum":
        return bool(values) and values[0] <= 2
    return key in _NEUTRAL and bool(values) and all(math.isclose(value, _NEUTRAL[key]) for value in values)
