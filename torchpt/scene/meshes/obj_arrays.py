"""Parse OBJ text in its usual form by array operations, without a step a line.

That is ASCII text in which all corners of faces have one form (``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``), counted from the
start, and all statements with a key as many numbers. Of anything else, damaged files included, :func:`parse_plain` returns
None: :mod:`torchpt.scene.meshes.obj` reads it line by line, and says what is wrong where.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CURVES", "Statements", "parse_plain"]

#: Statements of curves, surfaces, lines and points, which are not read.
CURVES = ("curv", "curv2", "surf", "l", "p")

Numbers = NDArray[np.float64]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass
class Statements:
    """What an OBJ file says.

    Attributes:
        positions: ``(n, 3)``.
        uvs: ``(n, 2)``, v counted from the bottom row.
        normals: ``(n, 3)``.
        corners: distinct corners ``(V, 3)`` of faces as zero-based v, vt, vn (-1: absent), in the order of the file.
        corner_of_word: ``(C,)`` the row of each corner of each face.
        counts: ``(F,)`` corners of each face.
        face_groups: ``(F,)`` the group of each face.
        groups: numbers of the groups by name of their material.
        libraries: MTL files that the file names.
        ignored: keys of statements that are not read.
    """

    positions: Numbers
    uvs: Numbers
    normals: Numbers
    corners: Integers
    corner_of_word: Integers
    counts: Integers
    face_groups: Integers
    groups: dict[str, int] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)


class _Odd(Exception):
    """Text that is not in the usual form."""


def parse_plain(data: bytes) -> Statements | None:
    """Return the statements of a file, or None where it is not in the usual form."""
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.isascii() or b"\\\n" in data:
        return None
    try:
        return _Lines(data).statements()
    except _Odd:
        return None


def _require(usual: Any) -> None:
    if not usual:
        raise _Odd


class _Lines:
    """The lines of a text, and how many words each has."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        text = self.text = np.frombuffer(data, np.uint8)
        newline = text == ord("\n")
        space = newline | (text == ord(" ")) | (text == ord("\t"))
        _require(len(text) and not ((text < 32) & ~space).any())
        starts = np.concatenate(([0], np.flatnonzero(newline) + 1))
        self.starts = starts[starts < len(text)]
        self.lengths = np.diff(self.starts, append=len(text))
        begins = ~space
        begins[1:] &= space[:-1]
        self.words = np.add.reduceat(begins, self.starts, dtype=np.int64)
        padded = np.concatenate((text, np.full(3, ord("\n"), np.uint8)))
        first, second, third = (padded[self.starts + k] for k in range(3))
        blank = np.zeros(128, bool)
        blank[[ord("\t"), ord("\n"), ord(" ")]] = True
        vertex = first == ord("v")
        self.of = {
            "v": vertex & blank[second],
            "vt": vertex & (second == ord("t")) & blank[third],
            "vn": vertex & (second == ord("n")) & blank[third],
            "f": (first == ord("f")) & blank[second],
        }
        plain = np.logical_or.reduce(list(self.of.values()))
        self.others = np.flatnonzero(~plain & (self.words > 0) & (first != ord("#")))

    def statements(self) -> Statements:
        """Parse all lines."""
        positions, uvs, normals = self._table("v", (3,)), self._table("vt", (2, 3))[:, :2], self._table("vn", (3,))
        corners, corner_of_word, counts = self._corners((len(positions), len(uvs), len(normals)))
        found = Statements(positions, uvs.copy(), normals, corners, corner_of_word, counts, np.zeros(0, np.int64))
        faces = np.flatnonzero(self.of["f"])
        changes, numbers = [-1], [-1]  # lines from which on faces belong to a group, and its number
        for line in self.others.tolist():
            start = int(self.starts[line])
            text = self.data[start : start + int(self.lengths[line])].decode("ascii").strip()
            key = text.split(None, 1)[0]
            # an indented statement, and one that is glued to its first number
            _require(key not in self.of and not key.startswith(("vt", "vn")))
            if key == "usemtl":
                if len(changes) == 1 and len(faces) and faces[0] < line:
                    numbers[0] = found.groups.setdefault("", 0)
                changes.append(line)
                numbers.append(found.groups.setdefault(text.removeprefix("usemtl").strip(), len(found.groups)))
            elif key == "mtllib":
                found.libraries.append(text.removeprefix("mtllib").strip())
            elif key in CURVES:
                found.ignored.append(key)
        if len(changes) == 1 and len(faces):
            numbers[0] = found.groups.setdefault("", 0)
        found.face_groups = np.array(numbers)[np.searchsorted(changes, faces, side="right") - 1]
        return found

    def _bytes(self, key: str) -> Bytes:
        """Return a copy of the text of all lines with a key, the key blanked."""
        mine = self.of[key]
        text = self.text[np.repeat(mine, self.lengths)]
        lengths = self.lengths[mine]
        starts = np.cumsum(lengths) - lengths
        for k in range(len(key)):
            text[starts + k] = ord(" ")
        _require(not (text == ord("#")).any())
        return text

    def _table(self, key: str, widths: tuple[int, ...]) -> Numbers:
        """Return the numbers of all statements with a key ``(n, width)``, of which all have one of some widths."""
        words = self.words[self.of[key]]
        if not len(words):
            return np.zeros((0, widths[0]))
        width = int(words[0]) - 1
        _require(width in widths and (words == width + 1).all())
        return _parsed(self._bytes(key), np.float64, len(words) * width).reshape(-1, width)

    def _corners(self, sizes: tuple[int, int, int]) -> tuple[Integers, Integers, Integers]:
        """Return the distinct corners, the row of each corner, and the number of each face's, as in :class:`Statements`."""
        counts = self.words[self.of["f"]] - 1
        if not len(counts):
            return np.zeros((0, 3), np.int64), np.zeros(0, np.int64), counts
        _require((counts >= 3).all())
        text, total = self._bytes("f"), int(counts.sum())
        _require(not (text == ord("-")).any())
        slash = text == ord("/")
        solid = (text != ord(" ")) & (text != ord("\t")) & (text != ord("\n"))
        begins = solid.copy()
        begins[1:] &= ~solid[:-1]
        slashes = np.add.reduceat(slash, np.flatnonzero(begins), dtype=np.int64)
        _require((slashes == slashes[0]).all() and slashes[0] <= 2)
        doubled = int((slash[1:] & slash[:-1]).sum())
        _require(doubled in (0, total))
        slots = [0, 2] if doubled else list(range(int(slashes[0]) + 1))
        text[slash] = ord(" ")
        numbers = _parsed(text, np.int64, total * len(slots)).reshape(total, len(slots))
        limits = np.array(sizes)
        _require((numbers >= 1).all() and (numbers <= limits[slots]).all())
        numbers -= 1
        key = numbers[:, 0]
        _require(float(np.prod(limits[slots].astype(np.float64))) < 2.0**62)
        for column, slot in enumerate(slots[1:], 1):
            key = key * sizes[slot] + numbers[:, column]
        _, first, row = np.unique(key, return_index=True, return_inverse=True)
        order = np.argsort(first)  # of the file
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        corners = np.full((len(order), 3), -1, np.int64)
        corners[:, slots] = numbers[first[order]]
        return corners, place[row.reshape(-1)], counts


def _parsed(text: Bytes, kind: Any, count: int) -> Any:
    """Return ``count`` numbers that stand in a text, between blanks."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # which says that something is no number
        try:
            found = np.fromstring(text.tobytes(), kind, sep=" ")
        except (DeprecationWarning, ValueError):
            raise _Odd from None
    _require(len(found) == count)
    return found
