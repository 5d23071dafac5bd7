"""Read PLY, ASCII and binary: the elements `vertex` and `face`; other elements are skipped.

A header declares *elements*, tables whose rows have the same *properties*: numbers, or lists with a length before the items.
Declared sizes are checked against the file's before memory is allocated.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.core.files import read_regular
from torchpt.scene.meshes.mesh import COLORED, MeshPart, checked, polygon_fans, smooth_normals
from torchpt.scene.meshes.ply_rows import find_mismatch

__all__ = ["load_ply", "load_ply_attribute"]

#: Types of the format, old and new names, and NumPy's without byte order.
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
#: Names that files have for one thing: the list of a face's vertices, colours, texture coordinates.
_INDICES = ("vertex_indices", "vertex_index")
_COLORS = (("red", "green", "blue"), ("r", "g", "b"))
#: Most bytes of a header.
_MOST_HEADER = 2**20
#: The last line of a header with its line end, of whichever kind.
_END = re.compile(rb"(?:^|\r)end_header[ \t]*(?:\r\n|\n|\r(?!\n))", re.MULTILINE)
_UVS = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"))


@dataclass
class _Property:
    """A column of an element, as the header declares it."""

    name: str
    kind: str  # numpy type of the value or of the list's items
    count: str = ""  # numpy type of a list's length; empty for a scalar


@dataclass
class _Element:
    """A table, as the header declares it."""

    name: str
    size: int  # number of rows
    properties: list[_Property] = field(default_factory=list)


#: The columns of an element by property: ``(n,)`` for numbers; for lists their lengths ``(n,)`` and all items in a row.
Columns = dict[str, Any]


def load_ply(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return the faces of a PLY file as one part; the format has no materials, but vertices may have colours.

    Raises:
        AssetError: a truncated or malformed file, or one without vertices.
    """
    vertex, face, elements = _read(path, data)
    return [_part(path, vertex, face, elements, materials)]


def load_ply_attribute(path: Path, name: str) -> MeshPart | None:
    """Return the faces of a PLY file with a mesh attribute of Mitsuba as their colours; None: the file has no such attribute.

    Mitsuba groups properties ``NAME_0``, or ``NAME_0 NAME_1 NAME_2`` (also ``1 2 3``, ``x y z``, ``r g b``), to the attributes
    ``vertex_NAME`` and ``face_NAME``; ``red green blue`` or ``r g b`` are ``vertex_color`` and ``face_color``. Colours are as
    :func:`load_ply` has them; one number is grey. Where faces have the attribute, they share no vertices in what is returned.

    Raises:
        OSError: the file cannot be read.
        AssetError: a truncated or malformed file.
    """
    vertex, face, elements = _read(path, read_regular(path))
    part = _part(path, vertex, face, elements, materials=False)
    owner, _, stem = name.partition("_")
    colors = _attribute({"vertex": vertex, "face": face}.get(owner, {}), owner, stem, elements)
    if colors is None or not len(part.faces):
        return None
    if owner == "vertex":
        return checked([replace(part, colors=colors)], path)[0]
    counts = next(face[key][0] for key in _INDICES if isinstance(face.get(key), tuple))
    part = checked([part], path)[0]
    normals = smooth_normals(part.vertices, part.faces) if part.normals is None else part.normals
    corners = part.faces.ravel()
    split = replace(
        part,
        vertices=part.vertices[corners],
        faces=np.arange(len(corners)).reshape(-1, 3),
        normals=normals[corners],
        uvs=None if part.uvs is None else part.uvs[corners],
        colors=np.repeat(np.repeat(colors, counts - 2, axis=0), 3, axis=0),  # each polygon is a fan of triangles
    )
    return checked([split], path)[0]


def _attribute(columns: Columns, owner: str, stem: str, elements: list[_Element]) -> NDArray[np.float64] | None:
    """Return the values ``(n, 3)`` of a mesh attribute, see :func:`load_ply_attribute`."""
    # Mitsuba 3.9 says `vertex_NAME_color` where the properties are `NAME_r` and so on
    plain = stem.removesuffix("_color")
    groups = [tuple(f"{stem}_{letter}" for letter in letters) for letters in ("012", "123", "xyz", "rgb")]
    groups += [tuple(f"{plain}_{letter}" for letter in "rgb")]
    if stem == "color":
        groups = [*_COLORS, *groups]
    for names in (*groups, (f"{stem}_0",) * 3, (f"{stem}_1",) * 3, (f"{stem}_x",) * 3, (f"{stem}_r",) * 3):
        found = _colors(columns, owner, elements, names)
        if found is not None:
            return found
    return None


def _read(path: Path, data: bytes) -> tuple[Columns, Columns, list[_Element]]:
    """Return the columns of the elements ``vertex`` and ``face``, the latter empty where there is none, and all elements."""
    layout, elements, start = _header(path, data)  # start: where the data begin
    reader = _Ascii(path, data, start, elements) if layout == "ascii" else _Binary(path, data, start, layout)
    found: dict[str, Columns] = {}
    for element in elements:
        columns = reader.read(element)
        if element.name in ("vertex", "face"):
            found[element.name] = columns
        if element.name in ("tristrips", "tristrip"):
            raise AssetError(path, "triangle strips (element tristrips) are not read; expected element face")
        if {"vertex", "face"} <= found.keys():
            break
    if "vertex" not in found:
        raise AssetError(path, "no element vertex")
    if isinstance(reader, _Ascii):
        reader.check_end()
    return found["vertex"], found.get("face", {}), elements


def _part(path: Path, vertex: Columns, face: Columns, elements: list[_Element], materials: bool) -> MeshPart:
    """Return the mesh of the columns of both elements.

    Args:
        path: the file.
        vertex: columns of the element ``vertex``.
        face: columns of the element ``face``; empty without it.
        elements: all elements of the header.
        materials: True for a material that shows vertex colours.

    Raises:
        AssetError: a missing property, a face of fewer than three corners.
    """
    missing = [name for name in "xyz" if not isinstance(vertex.get(name), np.ndarray)]
    if missing:
        problem = f"has a list as its property {missing[0]}, expected a number"
        problem = problem if missing[0] in vertex else f"has no property {missing[0]}"
        raise AssetError(path, f"element vertex {problem}")

    def stack(names: tuple[str, ...]) -> NDArray[np.float64] | None:  # None if a property is missing
        if not all(isinstance(vertex.get(name), np.ndarray) for name in names):
            return None
        return np.stack([np.asarray(vertex[name], dtype=np.float64) for name in names], axis=1)

    vertices = stack(("x", "y", "z"))
    assert vertices is not None
    uvs = next((pair for pair in map(stack, _UVS) if pair is not None), None)
    ignored = [name for name in face if name in ("texcoord", "texnumber")]
    ignored += [name for name in ("alpha", "diffuse_red") if name in vertex]
    if any(set(names) <= face.keys() for names in _COLORS):
        ignored.append("colours of faces")
    key = next((name for name in _INDICES if isinstance(face.get(name), tuple)), None)
    if key is None:
        if any(element.name == "face" and element.size for element in elements):
            raise AssetError(path, "element face has no list vertex_indices")
        return MeshPart(name="", vertices=vertices, faces=np.zeros((0, 3), dtype=np.int64))
    counts, items = face[key]
    too_few = np.flatnonzero(counts < 3)
    if len(too_few):
        raise AssetError(path, f"face {too_few[0]} has {counts[too_few[0]]} corners, expected three or more")
    if items.dtype.kind == "f":
        raise AssetError(path, "the vertex indices of element face are no integers")
    colors = next(
        (found for found in (_colors(vertex, "vertex", elements, names) for names in _COLORS) if found is not None),
        None,
    )
    own = COLORED if materials and colors is not None else None
    if own is not None and colors is not None and len(colors) and colors.max() > 1.0:
        raise AssetError(path, f"holds a colour above 1: {colors.max():g}; colours of floats are linear, from 0 to 1")
    starts = np.cumsum(counts) - counts
    faces = items.astype(np.int64)[polygon_fans(starts, counts)] if len(counts) else np.zeros((0, 3), np.int64)
    return MeshPart(
        name="",
        vertices=vertices,
        faces=faces,
        normals=stack(("nx", "ny", "nz")),
        uvs=uvs,
        colors=colors,
        material=own,
        ignored=tuple(ignored),
    )


def _colors(
    vertex: Columns, owner: str, elements: list[_Element], names: tuple[str, ...]
) -> NDArray[np.float64] | None:
    """Return linear RGB, or None if a property is missing: floats as stored, integers over the largest of their declared type.

    Args:
        vertex: columns of an element.
        owner: its name.
        elements: all elements of the header.
        names: three of its properties.
    """
    kinds = {p.name: p.kind for element in elements if element.name == owner for p in element.properties}
    if not all(isinstance(vertex.get(name), np.ndarray) for name in names):
        return None
    columns = []
    for name in names:
        white = 1.0 if kinds[name][0] == "f" else np.iinfo(kinds[name]).max
        columns.append(np.asarray(vertex[name], dtype=np.float64) / white)
    return np.stack(columns, axis=1)


def _header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Return the format (``ascii``, ``binary_little_endian`` or ``binary_big_endian``), the elements, and the header's size."""
    if not data.startswith(b"ply"):
        raise AssetError(path, "no PLY file (it does not start with ply)")
    found = _END.search(data, 0, _MOST_HEADER)
    if found is None:
        is_long = len(data) > _MOST_HEADER
        raise AssetError(
            path, f"no end_header in its first {_MOST_HEADER} bytes" if is_long else "truncated: no end_header"
        )
    layout, elements = "", []
    for line in data[: found.start()].decode("latin-1").replace("\r", "\n").split("\n"):
        words = line.split()
        problem = AssetError(path, f"header: {line.strip()[:60]!r} is not understood")
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3:
            layout = words[1]
        elif words[0] == "element" and len(words) == 3:
            if (
                not words[2].isdecimal() or not words[2].isascii() or len(words[2]) > 15
            ):  # so many digits that no file has the rows
                raise problem
            elements.append(_Element(words[1][:80], int(words[2])))
        elif words[0] == "property" and elements:
            elements[-1].properties.append(_property(words, problem))
        else:
            raise problem
    if layout not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise AssetError(path, f"header: unknown format {layout!r}")
    return layout, elements, found.end()


def _property(words: list[str], problem: AssetError) -> _Property:
    """Parse ``property TYPE NAME`` or ``property list TYPE_OF_LENGTH TYPE NAME``; raise ``problem`` for others."""
    if len(words) == 5 and words[1] == "list" and words[2] in _TYPES and words[3] in _TYPES:
        if _TYPES[words[2]][0] == "f":
            raise problem
        return _Property(words[4], kind=_TYPES[words[3]], count=_TYPES[words[2]])
    if len(words) == 3 and words[1] in _TYPES:
        return _Property(words[2], kind=_TYPES[words[1]])
    raise problem


def _truncated(path: Path, element: _Element, row: int | None = None) -> AssetError:
    """Return the error for a file that ends before the rows that it declares."""
    where = "" if row is None else f" (at {element.name} {row})"
    return AssetError(
        path, f"truncated: {element.size} of element {element.name} declared, the file is too short{where}"
    )


class _Binary:
    """Reader of the elements of a binary file, which are to be read in order; ``at`` is the offset of the next one."""

    def __init__(self, path: Path, data: bytes, start: int, layout: str) -> None:
        self.path, self.data, self.at = path, data, start
        self.order = "<" if layout == "binary_little_endian" else ">"

    def read(self, element: _Element) -> Columns:
        properties = element.properties
        smallest = sum(np.dtype(p.count or p.kind).itemsize for p in properties)
        if element.size * smallest > len(self.data) - self.at:
            raise _truncated(self.path, element)
        if not properties or not element.size:
            return {
                p.name: (np.zeros(0, np.int64), np.zeros(0, p.kind)) if p.count else np.zeros(0) for p in properties
            }
        columns = self.read_uniform(element)
        return self.read_ragged(element) if columns is None else columns

    def read_uniform(self, element: _Element) -> Columns | None:
        """Read all records at once; None where a list's length differs from that in the first record."""
        lengths, at = [], self.at
        for p in element.properties:
            length = 1
            if p.count:
                length = self.list_length(p.count, at, element, 0)
                at += np.dtype(p.count).itemsize
            at += length * np.dtype(p.kind).itemsize
            lengths.append(length)
        # The type of a whole row: for each property p0, p1, ... its values, and before a list n0, n1, ... its length.
        fields: list[Any] = []
        for slot, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
            if p.count:
                fields += [(f"n{slot}", self.order + p.count), (f"p{slot}", self.order + p.kind, (length,))]
            else:
                fields.append((f"p{slot}", self.order + p.kind))
        if at - self.at > len(self.data) or (at - self.at) * element.size > len(self.data) - self.at:
            return None
        records = np.frombuffer(self.data, np.dtype(fields), element.size, self.at)
        columns: Columns = {}
        for slot, (p, length) in enumerate(zip(element.properties, lengths, strict=True)):
            values = records[f"p{slot}"].astype(p.kind)
            if p.count:
                if (records[f"n{slot}"] != length).any():
                    return None
                columns[p.name] = (np.full(element.size, length, dtype=np.int64), values.reshape(-1))
            else:
                columns[p.name] = values
        self.at += records.nbytes
        return columns

    def read_ragged(self, element: _Element) -> Columns:
        """Read record by record, for lists of different lengths."""
        chunks: list[list[Any]] = [[] for _ in element.properties]
        counts: list[list[int]] = [[] for _ in element.properties]
        at = self.at
        for row in range(element.size):
            for slot, p in enumerate(element.properties):
                length = 1
                if p.count:
                    length = self.list_length(p.count, at, element, row)
                    at += np.dtype(p.count).itemsize
                size = length * np.dtype(p.kind).itemsize
                if length < 0 or at + size > len(self.data):
                    raise _truncated(self.path, element, row)
                chunks[slot].append(self.data[at : at + size])
                counts[slot].append(length)
                at += size
        self.at = at
        columns: Columns = {}
        for slot, p in enumerate(element.properties):
            values = np.frombuffer(b"".join(chunks[slot]), self.order + p.kind).astype(p.kind)
            columns[p.name] = (np.array(counts[slot], dtype=np.int64), values) if p.count else values
        return columns

    def list_length(self, kind: str, at: int, element: _Element, row: int) -> int:
        """Return the length of a list, of the type ``kind``, at an offset; raise where it is negative or beyond the file."""
        raw = self.data[at : at + np.dtype(kind).itemsize]
        if len(raw) < np.dtype(kind).itemsize:
            raise _truncated(self.path, element, row)
        value = int.from_bytes(raw, "little" if self.order == "<" else "big", signed=kind[0] == "i")
        if value < 0:
            raise AssetError(self.path, f"{element.name} {row} has a list of negative length")
        return value


class _Ascii:
    """Reader of the elements of an ASCII file, which are to be read in order; ``at`` is the index of the next word."""

    def __init__(self, path: Path, data: bytes, start: int, elements: list[_Element]) -> None:
        self.path, self.data, self.start, self.elements = path, data, start, elements
        self.words, self.at = data[start:].split(), 0

    def read(self, element: _Element) -> Columns:
        properties = element.properties
        if element.size * len(properties) > len(self.words) - self.at:
            raise self.wrong(_truncated(self.path, element).problem)
        if not any(p.count for p in properties):
            flat = self.take(element.size * len(properties), element, float)
            table = flat.reshape(-1, max(len(properties), 1))
            return {p.name: table[:, slot] for slot, p in enumerate(properties)}
        chunks: list[list[bytes]] = [[] for _ in properties]
        counts: list[list[int]] = [[] for _ in properties]
        for row in range(element.size):
            for slot, p in enumerate(properties):
                length = 1
                if p.count:
                    length = int(self.take(1, element, int)[0])
                if length < 0 or self.at + length > len(self.words):
                    raise self.wrong(_truncated(self.path, element, row).problem)
                chunks[slot] += self.words[self.at : self.at + length]
                counts[slot].append(length)
                self.at += length
        columns: Columns = {}
        for slot, p in enumerate(properties):
            values = self.convert(chunks[slot], element, float if p.kind[0] == "f" else int)
            columns[p.name] = (np.array(counts[slot], dtype=np.int64), values) if p.count else values
        return columns

    def take(self, size: int, element: _Element, kind: type) -> NDArray[Any]:
        """Return the next ``size`` words as numbers of a Python type, float or int."""
        if self.at + size > len(self.words):
            raise self.wrong(_truncated(self.path, element).problem)
        self.at += size
        return self.convert(self.words[self.at - size : self.at], element, kind)

    def convert(self, words: list[bytes], element: _Element, kind: type) -> NDArray[Any]:
        """Return words as numbers; raise for the first that is none."""
        try:
            return np.array(list(map(kind, words)), dtype=np.float64 if kind is float else np.int64)
        except (ValueError, OverflowError):
            expected = "a number" if kind is float else "a whole number of at most 64 bits"
            word = next(word for word in words if not _fits(word, kind))
            found = repr(word[:40].decode("latin-1"))
            raise self.wrong(f"element {element.name} holds {found}, expected {expected}") from None

    def wrong(self, problem: str) -> AssetError:
        """Return the error about the first row that does not match the header, else about ``problem``."""
        return AssetError(self.path, find_mismatch(self.data, self.start, self.elements) or problem)

    def check_end(self) -> None:
        """Raise if words are left behind the last faces: then rows were misaligned, although there were enough words."""
        read = [element for element in self.elements if element.size and element.properties]
        face_index = next((index for index, element in enumerate(read) if element.name == "face"), len(read))
        if face_index >= len(read) - 1 and self.at < len(self.words):
            found = find_mismatch(self.data, self.start, self.elements)
            if found is not None:
                raise AssetError(self.path, found)


def _fits(word: bytes, kind: type) -> bool:
    """Return True for a word that is a number of the type, of at most 64 bits."""
    try:
        return bool(np.array([kind(word)], dtype=np.float64 if kind is float else np.int64).size)
    except (ValueError, OverflowError):
        return False
