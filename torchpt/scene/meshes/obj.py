"""Read Wavefront OBJ: polygons with separate indices for position, texture and normal, grouped by material.

A *statement* is a line that begins with a key: ``v`` position, ``vt`` texture coordinate, ``vn`` normal, ``f`` face, ``usemtl``
material of the faces that follow, ``mtllib`` material file. A *corner* of a face is a word ``v/vt/vn`` of indices from 1, of
which vt and vn may be missing. Each distinct corner becomes a vertex, as in Mitsuba. Polygons are split into fans (right for
convex ones). Texture v is flipped: the format counts it from the bottom row.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.scene.meshes.mesh import (
    MOST_PARTS,
    FileMaterial,
    MeshPart,
    polygon_fans,
    smooth_normals,
    too_many_parts,
)
from torchpt.scene.meshes.mtl import decoded_lines, find_file, read_mtl
from torchpt.scene.meshes.obj_text import CURVES, Statements, parse_plain

__all__ = ["load_obj"]


@dataclass
class _Text:
    """The statements of a file by key (positions ``v``, texture coordinates ``vt``, normals ``vn``, faces ``f``), as written.

    Attributes:
        lines: the line number of each statement, for errors.
        face_groups: the number of each face's group.
        groups: numbers of the groups by name of their material.
        libraries: MTL files that the file names.
        ignored: keys of statements that are not read, and MTL files that are missing.
    """

    v: list[str] = field(default_factory=list)
    vt: list[str] = field(default_factory=list)
    vn: list[str] = field(default_factory=list)
    f: list[str] = field(default_factory=list)
    lines: dict[str, list[int]] = field(default_factory=lambda: {key: [] for key in ("v", "vt", "vn", "f")})
    face_groups: list[int] = field(default_factory=list)
    groups: dict[str, int] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)


def load_obj(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return the parts of an OBJ file, one per `usemtl` name.

    Raises:
        AssetError: a malformed line, an index out of range, a malformed MTL file.
    """
    text = parse_plain(data)
    if text is None:  # not in the usual form
        text = _by_lines(data, path)
    known = _libraries(text, path) if materials else {}
    if not len(text.counts):
        return []
    positions, uvs, normals = text.positions, text.uvs, text.normals
    corners, corner_of_word, counts = text.corners, text.corner_of_word, text.counts
    triangles = polygon_fans(np.cumsum(counts) - counts, counts)  # (F, 3) into the words of all faces
    group_of_triangle = np.repeat(text.face_groups, counts - 2)
    uvs[:, 1] = 1.0 - uvs[:, 1]
    # A vertex for each distinct corner.
    all_positions, all_faces = positions[corners[:, 0]], corner_of_word[triangles]
    all_uvs, all_normals = _looked_up(corners[:, 1], uvs), _looked_up(corners[:, 2], normals)
    if all_normals is None and len(text.groups) > 1 and np.isfinite(positions).all():
        all_normals = smooth_normals(all_positions, all_faces)  # over the whole file: groups meet without a crease
    if len(text.groups) > MOST_PARTS:
        raise too_many_parts(path)
    parts = []
    order = np.argsort(group_of_triangle, kind="stable")  # faces of a group stay in the order of the file
    ends = np.searchsorted(group_of_triangle[order], np.arange(1, len(text.groups) + 1))
    for (name, _), rows in zip(text.groups.items(), np.split(order, ends[:-1]), strict=True):
        used, faces = _own_rows(all_faces[rows], len(corners))
        material = known.get(name)
        if material is None and name and materials:
            material = FileMaterial(name, ignored=("not defined in an MTL file",))
        part_normals = None if all_normals is None else all_normals[used]
        part_uvs = None if all_uvs is None else all_uvs[used]
        parts.append(
            MeshPart(
                name=name,
                vertices=all_positions[used],
                faces=faces,
                normals=part_normals,
                uvs=part_uvs,
                material=material,
                ignored=tuple(dict.fromkeys(text.ignored)),
            )
        )
    return parts


def _own_rows(faces: NDArray[np.int64], count: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of ``count`` vertices some faces ``(F, 3)`` have, in order, and the faces in terms of these."""
    if 8 * faces.size < count:  # few of them: a file may have many groups
        used, inverse = np.unique(faces, return_inverse=True)
        return used, inverse.reshape(faces.shape)
    is_used = np.zeros(count, bool)
    is_used[faces] = True
    return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[faces]


def _by_lines(data: bytes, path: Path) -> Statements:
    """Return the statements of any file, read line by line.

    Raises:
        AssetError: names the first line that is malformed.
    """
    text = _split(decoded_lines(data), path)
    positions = _numbers(text, "v", 3, path)
    uvs = _numbers(text, "vt", 2, path)
    normals = _numbers(text, "vn", 3, path)
    none = np.zeros(0, np.int64)
    corners, corner_of_word, counts = np.zeros((0, 3), np.int64), none, none
    if text.f:
        corners, corner_of_word, counts = _corners(text, path, (len(positions), len(uvs), len(normals)))
    return Statements(
        positions,
        uvs,
        normals,
        corners,
        corner_of_word,
        counts,
        np.array(text.face_groups, np.int64),
        text.groups,
        text.libraries,
        text.ignored,
    )


def _split(lines: list[str], path: Path) -> _Text:
    """Sort the lines of a file into statements; faces without a material before them form the group ""."""
    text = _Text()
    tables = {"v": text.v, "vt": text.vt, "vn": text.vn}
    group = -1  # of the faces that follow; -1 before the first `usemtl`
    for number, line in enumerate(lines, 1):
        key = line[:2].rstrip()  # enough for most lines, and fast
        if key not in ("v", "vt", "vn", "f"):
            key = (line.split(None, 1) or ("",))[0]
        if key in tables:
            tables[key].append(line)
            text.lines[key].append(number)
        elif key == "f":
            if group < 0:
                group = text.groups.setdefault("", len(text.groups))
            if "#" in line or "-" in line:
                words = line.partition("#")[0].split()
                line = " ".join(_absolute(words, (len(text.v), len(text.vt), len(text.vn)), path, number))
            text.f.append(line)
            text.lines["f"].append(number)
            text.face_groups.append(group)
        elif key == "usemtl":
            name = line.strip().removeprefix("usemtl").strip()
            group = text.groups.setdefault(name, len(text.groups))
        elif key == "mtllib":
            text.libraries.append(line.strip().removeprefix("mtllib").strip())
        elif key in CURVES:
            text.ignored.append(key)
    return text


def _absolute(words: list[str], counts: tuple[int, int, int], path: Path, number: int) -> list[str]:
    """Replace negative indices of a face, which count back from its statement, by positive ones.

    Args:
        words: ``f`` and the corners of the face.
        counts: number of positions, texture coordinates and normals before the statement.
        path: the file.
        number: line number, for errors.

    Raises:
        AssetError: no corner, or one that counts back too far.
    """
    result = [words[0]]
    for word in words[1:]:
        indices = word.split("/")
        for slot, index in enumerate(indices[:3]):
            if index.startswith("-"):
                try:
                    absolute = counts[slot] + 1 + int(index)
                except ValueError:
                    raise AssetError(path, f"line {number}: {word!r} is no corner v/vt/vn") from None
                if absolute < 1:
                    raise AssetError(path, f"line {number}: corner {word!r} counts back beyond the first element")
                indices[slot] = str(absolute)
        result.append("/".join(indices))
    return result


def _libraries(text: Statements, path: Path) -> dict[str, FileMaterial]:
    """Return the materials of all MTL files by name; missing files are added to ``text.ignored``."""
    known: dict[str, FileMaterial] = {}
    for name in text.libraries:
        whole = find_file(path, name)  # a name may hold blanks; else blanks separate several names
        files = [whole] if whole is not None else [find_file(path, word) for word in name.split()]
        if not files or None in files:  # MTL files are often missing; the shape can be rendered without
            text.ignored.append(f"mtllib {name} (no such file)")
        for file in files:
            if file is not None:
                known.update(read_mtl(file, set(text.groups)))
    return known


def _numbers(text: _Text, key: str, columns: int, path: Path) -> NDArray[np.float64]:
    """Return the first ``columns`` numbers of each statement with a key: ``(n, columns)``; a one-number `vt` gets v = 0.

    Raises:
        AssetError: names the line without that many numbers.
    """
    rows: list[str] = getattr(text, key)
    words = " ".join(rows).split()
    width = columns + 1
    if len(words) == width * len(rows) and words[::width] == [key] * len(rows):  # the usual form, in bulk
        del words[::width]
        try:
            return np.array(list(map(float, words)), dtype=np.float64).reshape(-1, columns)
        except ValueError:
            pass  # the loop below finds the line
    result = np.zeros((len(rows), columns))
    for index, (number, row) in enumerate(zip(text.lines[key], rows, strict=True)):
        found = row.partition("#")[0].split()
        if key == "v" and len(found) >= 7:  # the key and six numbers
            text.ignored.append("v x y z r g b (colours)")
        try:
            values = [float(word) for word in found[1:width]]
        except ValueError:
            values = []
        if len(values) != columns and not (key == "vt" and len(values) == 1):
            raise AssetError(path, f"line {number}: expected {key} and {columns} numbers, got {row.strip()[:60]!r}")
        result[index, : len(values)] = values
    return result


def _corners(
    text: _Text, path: Path, sizes: tuple[int, int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Parse the corners of all faces; ``sizes``: number of positions, texture coordinates and normals of the file.

    Returns:
        The distinct corners ``(V, 3)`` as zero-based v, vt, vn (-1: absent); the row of each corner of each face ``(C,)``;
        the number of corners of each face.

    Raises:
        AssetError: a face of fewer than three corners, a malformed corner, an index out of range.
    """
    words = " ".join(text.f).split()
    heads = np.array([at for at, word in enumerate(words) if word == "f"])  # where each face begins
    counts = np.diff(heads, append=len(words)) - 1
    if len(heads) != len(text.f) or (counts < 3).any():
        face = int(np.argmax(counts < 3)) if len(heads) == len(text.f) else 0
        line = text.f[face].strip()[:60]
        raise AssetError(path, f"line {text.lines['f'][face]}: a face needs three or more corners: {line!r}")
    corners = [word for word in words if word != "f"]
    numbers = {word: row for row, word in enumerate(dict.fromkeys(corners))}
    index = np.array(list(map(numbers.__getitem__, corners)), dtype=np.int64)

    def line_of(word: str) -> int:
        return text.lines["f"][int(np.searchsorted(np.cumsum(counts), corners.index(word), side="right"))]

    table = np.full((len(numbers), 3), -1, dtype=np.int64)  # the index 0, which the format does not have, becomes -2
    for row, word in enumerate(numbers):
        try:
            for slot, part in enumerate(word.split("/")):
                if part:
                    table[row, slot] = int(part) - 1 if int(part) else -2
        except (ValueError, IndexError, OverflowError):
            raise AssetError(path, f"line {line_of(word)}: {word[:40]!r} is no corner v/vt/vn") from None
    bad = np.flatnonzero((table < -1).any(axis=1) | (table >= np.array(sizes)).any(axis=1) | (table[:, 0] < 0))
    if len(bad):
        word = list(numbers)[bad[0]]
        found = f"{sizes[0]} v, {sizes[1]} vt, {sizes[2]} vn"
        raise AssetError(
            path, f"line {line_of(word)}: corner {word!r} has an index out of range (the file has {found})"
        )
    return table, index, counts


def _looked_up(indices: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return rows of ``values`` by index, zeros for index -1; None where all indices are -1."""
    if not len(values) or (indices < 0).all():
        return None
    return np.where((indices >= 0)[:, None], values[np.maximum(indices, 0)], 0.0)
