"""Parse OBJ text in its usual form by machine code (module ``obj_text`` of :mod:`torchpt.native.kernels`).

That is ASCII text in which lines begin with their key, positions and normals have three numbers, texture coordinates two or
three, and all indices are in range. Of anything else, damaged files included, :func:`parse_plain` returns None:
:mod:`torchpt.scene.meshes.obj` reads it line by line, and says what is wrong where.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchpt.native.kernels import kernel

__all__ = ["CURVES", "Statements", "parse_plain"]

#: Statements of curves, surfaces, lines and points, which are not read.
CURVES = ("curv", "curv2", "surf", "l", "p")
#: Keys of what is read as numbers. In a line of its own form such a key is the first word, and a blank comes behind it.
_NUMBERED = ("v", "f", "vt", "vn")
#: Powers of ten that are float64.
_POWERS = np.array([float(10**k) for k in range(23)])

Numbers = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass
class Statements:
    """The contents of an OBJ file.

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


def parse_plain(data: bytes) -> Statements | None:
    """Return the statements of a file, or None where it is not in the usual form."""
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.endswith(b"\n"):
        data += b"\n"
    text, sizes = np.frombuffer(data, np.uint8), np.empty(6, np.int64)
    if not kernel("obj_text", "count")(text, len(data), sizes):
        return None
    v, vt, vn, faces, corner_count, other_count = sizes.tolist()
    numbers = np.empty(3 * v + 2 * vt + 3 * vn)
    corners, sides = np.empty((corner_count, 3), np.int64), np.empty(faces, np.int64)
    others, inexact = np.empty((other_count, 2), np.int64), np.empty((len(numbers), 3), np.int64)
    found = kernel("obj_text", "read")(
        text, len(data), _POWERS, sizes, numbers, corners, sides, others, inexact
    )  # fmt: skip
    if found < 0:
        return None
    for place, begin, end in inexact[:found].tolist():
        numbers[place] = float(data[begin:end])
    rows = np.empty(corner_count, np.int64)
    size = 1 << (2 * corner_count).bit_length()
    distinct = kernel("obj_text", "distinct")(corners, corner_count, np.full(size, -1, np.int32), size, rows)
    statements = Statements(
        positions=numbers[: 3 * v].reshape(v, 3),
        uvs=numbers[3 * v : 3 * v + 2 * vt].reshape(vt, 2),
        normals=numbers[3 * v + 2 * vt :].reshape(vn, 3),
        corners=corners[:distinct],
        corner_of_word=rows,
        counts=sides,
        face_groups=np.zeros(0, np.int64),
    )
    return statements if _read_others(statements, data, others) else None


def _read_others(statements: Statements, data: bytes, others: Integers) -> bool:
    """Read all lines without numbers, ``(n, 2)`` their begin and the faces before them; return False for an odd one."""
    groups, faces = statements.groups, len(statements.counts)
    begins, numbers = [0], [-1]  # faces from which on faces belong to a group, and its number
    for begin, before in others.tolist():
        text = data[begin : data.index(b"\n", begin)].decode("ascii").strip()
        key = text.split(None, 1)[0]
        if key in _NUMBERED or key.startswith(("vt", "vn")):  # indented, or glued to its first number
            return False
        if key == "usemtl":
            if len(begins) == 1 and before:
                numbers[0] = groups.setdefault("", 0)
            begins.append(before)
            numbers.append(groups.setdefault(text.removeprefix("usemtl").strip(), len(groups)))
        elif key == "mtllib":
            statements.libraries.append(text.removeprefix("mtllib").strip())
        elif key in CURVES:
            statements.ignored.append(key)
    if len(begins) == 1 and faces:
        numbers[0] = groups.setdefault("", 0)
    statements.face_groups = np.repeat(np.array(numbers, np.int64), np.diff(begins, append=faces))
    return True
