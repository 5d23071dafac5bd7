"""Read Mitsuba's binary format `.serialized`, versions 3 and 4: several meshes in a file, each compressed by zlib.

The layout is that of Mitsuba's documentation of its plugin `serialized`. A mesh starts with two 16-bit numbers, 0x041C and the
version; a zlib stream follows: flags, name (version 4), number of vertices and of faces, then positions, normals, texture
coordinates, colours and indices, one array after the other. The file ends with the offset of each mesh and their number.
Everything is little-endian.
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.core.files import MAX_BYTES, check_regular
from torchpt.scene.meshes.mesh import COLORED, MAX_UNPACKED, MOST_PARTS, MeshPart, too_many_parts

__all__ = ["load_serialized", "load_serialized_mesh"]

_MAGIC = 0x041C
#: Version -> type of the offsets at the end.
_OFFSETS = {3: "<u4", 4: "<u8"}
# Flags. Those of single precision (0x1000) and of tangents (0x4, never written) change nothing.
_NORMALS, _UVS, _COLORS, _FACE_NORMALS, _DOUBLE = 0x1, 0x2, 0x8, 0x10, 0x2000
#: Most bytes of a name.
_MOST_NAME = 2**12
#: Bytes that zlib is given at once.
_CHUNK = 2**16


def load_serialized(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return all meshes of a file, each as one part.

    Raises:
        AssetError: a truncated or malformed file.
    """
    file = io.BytesIO(data)
    unpacked, parts = 0, []
    starts = _offsets(path, file, len(data)).tolist()
    for number, (start, end) in enumerate(zip(starts, [*starts[1:], len(data)], strict=True)):
        part, size = _read(path, file, (start, end), number, materials, MAX_UNPACKED - unpacked)
        unpacked += size
        parts.append(part)
    return parts


def load_serialized_mesh(path: Path, index: int, materials: bool) -> list[MeshPart]:
    """Return one mesh of a file as a list of one part; only this mesh is read.

    Args:
        path: the file.
        index: number of the mesh, from 0.
        materials: True for a material that shows vertex colours.

    Raises:
        OSError: the file cannot be read.
        AssetError: a truncated or malformed file, or one of fewer meshes.
    """
    size = check_regular(path, MAX_BYTES)
    with Path(path).open("rb") as file:
        start, end = 0, size  # the first one is found without the offsets, which some files lack
        if index:
            starts = _offsets(path, file, size)
            if index >= len(starts):
                raise AssetError(
                    path, f"has {len(starts)} meshes, 0..{len(starts) - 1}; shape_index {index} is asked for"
                )
            start, end = [*starts.tolist(), size][index : index + 2]
        return [_read(path, file, (start, end), index, materials, MAX_UNPACKED)[0]]


def _offsets(path: Path, file: BinaryIO, size: int) -> NDArray[np.int64]:
    """Return where each mesh starts."""
    version = _version(path, file, 0, 0)
    kind = np.dtype(_OFFSETS[version])
    file.seek(max(size - 4, 0))
    count = int.from_bytes(file.read(4), "little")
    if count > MOST_PARTS and size >= 4 + count * kind.itemsize:
        raise too_many_parts(path)
    at = size - 4 - count * kind.itemsize
    if not count or at < 4:
        raise AssetError(path, f"truncated: its last number says {count} meshes, {size} bytes do not hold them")
    file.seek(at)
    starts = np.frombuffer(file.read(count * kind.itemsize), kind, count)
    bad = np.flatnonzero(starts >= np.uint64(at))
    if starts[0] != 0 or len(bad) or (starts[1:] <= starts[:-1]).any():
        falls = np.flatnonzero(starts[1:] <= starts[:-1]) + 1
        first = next((found[0] for found in (bad, falls) if len(found)), 0)
        raise AssetError(path, f"truncated or malformed: the offset of mesh {first} is {starts[first]}")
    return starts.astype(np.int64)


def _version(path: Path, file: BinaryIO, start: int, number: int) -> int:
    """Return the version of a mesh; the file is then at the start of its stream."""
    file.seek(start)
    header = file.read(4)
    if len(header) < 4 or int.from_bytes(header[:2], "little") != _MAGIC:
        raise AssetError(path, f"mesh {number} does not start with 0x041C, as those of a serialized file do")
    version = int.from_bytes(header[2:], "little")
    if version not in _OFFSETS:
        raise AssetError(path, f"mesh {number} is of version {version}; versions 3 and 4 are read")
    return version


def _read(
    path: Path, file: BinaryIO, span: tuple[int, int], number: int, materials: bool, most: int
) -> tuple[MeshPart, int]:
    """Return a mesh and the bytes that it unfolds to.

    Args:
        path: the file, for errors.
        file: the same, open.
        span: where the mesh starts and the next one.
        number: its index, for errors.
        materials: True for a material that shows vertex colours.
        most: largest number of bytes that it may unfold to.
    """
    start, end = span
    version = _version(path, file, start, number)
    stream = _Stream(path, file, number, end - start - 4)
    (flags,) = struct.unpack("<I", stream.take(4))
    name = stream.name() if version == 4 else ""
    vertices, faces = struct.unpack("<QQ", stream.take(16))
    double = bool(flags & _DOUBLE)
    real, index = np.dtype("<f8" if double else "<f4"), np.dtype("<u8" if vertices > 0xFFFFFFFF else "<u4")
    columns = 3 + sum(width for flag, width in ((_NORMALS, 3), (_UVS, 2), (_COLORS, 3)) if flags & flag)
    size = len(name) + vertices * columns * real.itemsize + faces * 3 * index.itemsize
    if size > most:
        problem = f"mesh {number} unfolds to {size} bytes ({vertices} vertices, {faces} faces); at most {most} are read"
        raise AssetError(path, problem)

    def rows(count: int, width: int, kind: Any) -> NDArray[Any]:
        return np.frombuffer(stream.take(count * width * np.dtype(kind).itemsize), kind).reshape(count, width)

    def attribute(flag: int, width: int) -> NDArray[np.float64] | None:
        return rows(vertices, width, real).astype(np.float64) if flags & flag else None

    positions = rows(vertices, 3, real).astype(np.float64)
    normals, uvs, colors = attribute(_NORMALS, 3), attribute(_UVS, 2), attribute(_COLORS, 3)
    corners = rows(faces, 3, index).astype(np.int64)
    part = MeshPart(
        name=name,
        vertices=positions,
        faces=corners,
        normals=normals,
        uvs=uvs,
        colors=colors,
        flat=bool(flags & _FACE_NORMALS),
        material=COLORED if materials and colors is not None else None,
    )
    return part, size


class _Stream:
    """The zlib stream of a mesh, decompressed only as far as is asked for.

    Args:
        path: the file, for errors.
        file: the same, open where the stream starts.
        number: index of the mesh, for errors.
        size: bytes up to the next mesh.
    """

    def __init__(self, path: Path, file: BinaryIO, number: int, size: int) -> None:
        self.path, self.file, self.number, self.left = path, file, number, size
        self.inflate, self.packed, self.ready = zlib.decompressobj(), b"", bytearray()

    def _more(self, most: int) -> bool:
        """Decompress up to ``most`` bytes further; return False at the end of the stream."""
        if not self.packed:
            self.packed = self.file.read(min(_CHUNK, self.left))
            self.left -= len(self.packed)
        if self.inflate.eof or not self.packed:
            return False
        try:
            self.ready += self.inflate.decompress(self.packed, most)
        except zlib.error as error:
            raise AssetError(self.path, f"mesh {self.number} is malformed ({error})") from None
        self.packed = self.inflate.unconsumed_tail
        return True

    def take(self, size: int) -> bytearray:
        """Return the next bytes.

        Raises:
            AssetError: the stream is malformed, or ends before.
        """
        while len(self.ready) < size and self._more(size - len(self.ready)):
            pass
        if len(self.ready) < size:
            problem = f"truncated: mesh {self.number} has {len(self.ready)} bytes where {size} are declared"
            raise AssetError(self.path, problem)
        found, self.ready = self.ready[:size], self.ready[size:]
        return found

    def name(self) -> str:
        """Return the next text, which ends with a zero."""
        while b"\0" not in self.ready and len(self.ready) <= _MOST_NAME and self._more(_MOST_NAME):
            pass
        end = self.ready.find(b"\0")
        if not 0 <= end <= _MOST_NAME:
            raise AssetError(self.path, f"mesh {self.number} has a name of more than {_MOST_NAME} bytes, or none")
        return self.take(end + 1)[:end].decode("utf-8", "replace")
