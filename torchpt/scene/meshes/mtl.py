"""Parse MTL material files, which OBJ files name; :mod:`mtl_material` converts their statements to materials.

A *statement* is a line that begins with a key; those behind ``newmtl NAME`` belong to that material. A *map* is the statement
of an image.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from torchpt.core.errors import AssetError
from torchpt.core.files import is_regular, read_regular
from torchpt.scene.meshes.mesh import FileMaterial, Rgb
from torchpt.scene.meshes.mtl_material import COLORS, MAPS, NUMBERS, Map, Statements, material_of

__all__ = ["decoded_lines", "find_file", "read_mtl"]

#: Options of a map statement, and the most words that follow each.
_OPTIONS = {
    **{"-blendu": 1, "-blendv": 1, "-cc": 1, "-clamp": 1, "-texres": 1, "-bm": 1, "-boost": 1, "-imfchan": 1},
    **{"-type": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-colorspace": 1},
}
#: Options that take one to three numbers.
_VECTORS = ("-o", "-s", "-t")
#: Options that are converted, and those that make no difference to a converted material; all others are reported.
_READ_OPTIONS = ("-bm", "-s", "-o", "-clamp", "-imfchan")
_NEUTRAL_OPTIONS = ("-blendu", "-blendv", "-cc", "-texres")
#: Words of ``-imfchan``, and the channels of image textures.
_CHANNELS = {"": None, "r": "r", "g": "g", "b": "b", "m": "a", "l": "luminance"}
#: Statements that make no difference: ambient light (computed, not given), its map, the sharpness of reflection maps,
#: anti-aliasing of maps.
_NEUTRAL = ("ka", "map_ka", "sharpness", "map_aat")
#: Largest numbers of a statement and of an option: they become float32.
_LARGEST, _LARGEST_OPTION = 3e38, 1e6


def decoded_lines(data: bytes) -> list[str]:
    """Return the lines of a text file; lines that end in a backslash are joined with the next.

    Empty lines stand in for joined ones, so that line numbers stay right.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if "\\" not in text:
        return lines
    number = 0
    while number < len(lines):
        end = number
        while lines[end].endswith("\\") and end + 1 < len(lines):
            lines[end] = lines[end][:-1]
            end += 1
        if end > number:
            lines[number] = " ".join(lines[number : end + 1])
            lines[number + 1 : end + 1] = [""] * (end - number)
        number = end + 1
    return lines


def find_file(path: Path, name: str) -> Path | None:
    """Return the file that a statement in ``path`` names, or None.

    Names with backslashes are accepted, and those whose folder is missing, where a file of the same name lies beside ``path``.
    """
    forward = name.replace("\\", "/")
    for form in dict.fromkeys((name, forward, forward.rpartition("/")[2])):
        candidate = path.parent / form
        if form and is_regular(candidate):
            return candidate
    return None


def read_mtl(path: Path, wanted: set[str]) -> dict[str, FileMaterial]:
    """Return the materials of an MTL file by name.

    Args:
        path: the file.
        wanted: names of the materials that are used; images of the others need not exist.

    Raises:
        AssetError: a file that cannot be read, a malformed statement, a missing image.
    """
    try:
        lines = decoded_lines(read_regular(path))
    except OSError as error:
        raise AssetError(path, f"cannot be read ({error.strerror})") from None
    found: dict[str, Statements] = {}
    current: Statements | None = None
    for number, line in enumerate(lines, 1):
        key, *rest = line.strip().split(None, 1)[:2] or ("",)
        if not key or key.startswith("#"):
            continue
        text = rest[0].strip() if rest else ""
        if key.lower() == "newmtl":
            if not text:
                raise AssetError(path, f"line {number}: newmtl without a name")
            current = found[text] = Statements()
        elif current is not None:
            _add(current, key, text, _Line(path, number))
    return {name: _finished(name, statements, path) for name, statements in found.items() if name in wanted}


@dataclass(frozen=True)
class _Line:
    """A line of a file, for errors."""

    path: Path
    number: int

    def wrong(self, expected: str, found: str) -> AssetError:
        """Return the error that names the line."""
        return AssetError(self.path, f"line {self.number}: expected {expected}, got {found[:60]!r}")


def _add(statements: Statements, key: str, text: str, line: _Line) -> None:
    """Parse a statement and add it to those of its material; ``text``: what follows the key."""
    lower = key.lower()
    # The kind of a map: its key under one of several spellings.
    kind = lower.replace("map_bump", "bump").replace("map_norm", "norm").replace("map_opacity", "map_d")
    if lower in COLORS:
        if text.split()[:1] in (["spectral"], ["xyz"]):
            statements.ignored.append(f"{key} {text.split()[0]}")
        else:
            statements.colors[lower] = _color(text, key, line)
    elif lower in NUMBERS:
        words = text.partition("#")[0].split()
        if words[:1] == ["-halo"]:
            statements.ignored.append(f"{key} -halo")
            words = words[1:]
        try:
            (value,) = map(float, words)  # a ValueError too where there is not exactly one
        except (ValueError, OverflowError):
            value = float("nan")
        if not abs(value) <= _LARGEST:  # NaN too
            raise line.wrong(f"{key} and one finite number", text)
        statements.numbers[lower] = value
    elif kind in MAPS:
        statements.maps[kind] = _map(key, text, line)
    elif lower not in _NEUTRAL:
        statements.ignored.append(key)


def _color(text: str, key: str, line: _Line) -> Rgb:
    """Parse a colour: three numbers, or one for grey."""
    try:
        values = [float(word) for word in text.partition("#")[0].split()]
    except ValueError:
        values = []
    if len(values) == 1:
        values *= 3
    if len(values) != 3 or not all(0 <= value <= _LARGEST for value in values):
        raise line.wrong(f"{key} r g b, finite and >= 0", text)
    return values[0], values[1], values[2]


def _map(key: str, text: str, line: _Line) -> Map:
    """Parse a map statement: options, then a file name that may hold blanks."""
    found = list(re.finditer(r"\S+", text))  # words, and where each begins
    words, starts, at = [word[0] for word in found], [word.start() for word in found], 0
    options: dict[str, list[str]] = {}
    while at < len(words) - 1 and words[at].lower() in _OPTIONS:
        option = words[at].lower()
        end = at + 1
        while end < len(words) and end - at <= _OPTIONS[option] and (option not in _VECTORS or _is_number(words[end])):
            end += 1
        if option in _VECTORS and end == len(words):
            end -= 1  # a file may be called 1
        options[option] = words[at + 1 : end]
        at = end
    file_name = text[starts[at] :] if at < len(starts) else ""
    if not file_name:
        raise line.wrong(f"{key} and the name of a file", text)

    def numbers(option: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return as many numbers of an option as the default has, which fills up missing ones."""
        try:
            given = tuple(map(float, options.get(option, ())))
        except ValueError:
            given = (float("nan"),)
        if not all(abs(value) <= _LARGEST_OPTION for value in given):
            raise line.wrong(f"{option} and numbers", text)
        return (given + default[len(given) :])[: len(default)]

    ignored = [f"{key} {option}" for option in options if option not in (*_READ_OPTIONS, *_NEUTRAL_OPTIONS)]
    channel = (options.get("-imfchan") or [""])[0].lower()
    if channel not in _CHANNELS:
        ignored.append(f"{key} -imfchan {channel}")
    offset, scale = numbers("-o", (0.0, 0.0)), numbers("-s", (1.0, 1.0))
    if "-s" in options and len(options["-s"]) == 1:
        scale = (scale[0], scale[0])
    return Map(
        key=key,
        name=file_name,
        line=line.number,
        bump=numbers("-bm", (1.0,))[0],
        offset=(offset[0], offset[1]),
        scale=(scale[0], scale[1]),
        clamp=(options.get("-clamp") or ["off"])[0].lower() == "on",
        channel=_CHANNELS.get(channel),
        ignored=tuple(ignored),
    )


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _finished(name: str, statements: Statements, path: Path) -> FileMaterial:
    """Find the images of a material and convert its statements.

    Raises:
        AssetError: a missing image.
    """
    files: dict[str, str] = {}
    for kind, found in statements.maps.items():
        # The name as it stands, else without a comment behind it.
        file = find_file(path, found.name) or find_file(path, found.name.partition("#")[0].strip())
        if file is None:
            raise AssetError(path, f"line {found.line}: the image file {found.name[:80]!r} is missing")
        files[kind] = str(file.resolve())
    material, ignored = material_of(statements, files)
    return FileMaterial(name, material, tuple(dict.fromkeys([*statements.ignored, *ignored])))
