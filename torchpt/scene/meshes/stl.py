"""Read STL, binary and ASCII: separate triangles, welded at equal corners so that smooth normals can be computed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError
from torchpt.scene.meshes.mesh import MeshPart

__all__ = ["load_stl"]

#: A triangle of a binary file: 50 bytes, little-endian.
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
#: Bytes of the header: 80 of any text, then the number of triangles as 32-bit integer.
_HEADER = 84


def load_stl(path: Path, data: bytes, materials: bool) -> list[MeshPart]:
    """Return the triangles of an STL file as one part; its facet normals are not used.

    Raises:
        AssetError: a truncated or malformed file.
    """
    del materials  # the format has none
    declared = int.from_bytes(data[80:84], "little") if len(data) >= _HEADER else -1
    size = _HEADER + _RECORD.itemsize * declared  # bytes of a binary file of so many triangles
    # Some binary files begin with "solid" too, but have all bytes that their header declares; text in its place declares
    # gigabytes.
    if data.lstrip()[:5].lower() == b"solid" and not 0 <= declared <= (len(data) - _HEADER) // _RECORD.itemsize:
        corners = _ascii(path, data)
    elif declared < 0:
        raise AssetError(path, f"truncated: {len(data)} bytes, an STL file has at least {_HEADER}")
    elif len(data) < size:
        raise AssetError(path, f"truncated: {declared} triangles need {size} bytes, got {len(data)}")
    else:
        records = np.frombuffer(data, _RECORD, declared, _HEADER)
        corners = records["corners"].astype(np.float64).reshape(-1, 3)
    if not len(corners):
        return []
    vertices, index = np.unique(corners + 0.0, axis=0, return_inverse=True)  # + 0.0: -0 and 0 are one corner
    return [MeshPart(name="", vertices=vertices, faces=index.reshape(-1, 3).astype(np.int64))]


def _ascii(path: Path, data: bytes) -> NDArray[np.float64]:
    """Return the corners ``(3 F, 3)`` of an ASCII file."""
    # The rest of these lines is a name, of any words; a file on one line has none.
    unnamed = re.sub(rb"(?im)(^|(?<=\r))([ \t]*(?:end)?solid\b)[^\r\n]*", rb"\2", data)
    words = (unnamed if b"vertex" in unnamed.lower() else data).split()
    keys = [word.lower() for word in words]  # writers differ in case
    if b"endsolid" not in keys:
        raise AssetError(path, "truncated: no endsolid")
    is_vertex = np.array([key == b"vertex" for key in keys])
    starts = np.flatnonzero(is_vertex)  # three numbers follow each
    if len(starts) % 3 or (len(starts) and starts[-1] + 3 >= len(words)):
        raise AssetError(path, f"truncated: {len(starts)} corners are no whole number of triangles")
    try:
        flat = [float(words[start + offset]) for start in starts.tolist() for offset in (1, 2, 3)]
    except ValueError:
        raise AssetError(path, "a vertex statement without three numbers") from None
    return np.array(flat, dtype=np.float64).reshape(-1, 3)
