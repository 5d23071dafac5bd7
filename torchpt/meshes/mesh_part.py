"""What a mesh loader hands over, and the checks that every format shares."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchpt.errors import AssetError
from torchpt.meshes.normals import smooth_normals

__all__ = [
    "MOST_PARTS", "FileCamera", "FileLight", "FileMaterial", "MeshPart", "checked", "corners_of_polygons", "too_many",
    "transformed",
]  # fmt: skip

#: Parts that one file may come to: groups of an OBJ file, placed primitives of a glTF file.
MOST_PARTS = 100_000

_LARGEST = float(np.finfo(np.float32).max)

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class FileMaterial:
    """A mesh file's own material.

    Attributes:
        name: as in the file.
        material: what a scene file would have: ``type``, parameters, textures inline with absolute paths or
            `EncodedImage`.
        ignored: what the file says about the look and torchpt does not read, by the file's names.
    """

    name: str
    material: dict[str, Any] = field(default_factory=lambda: {"type": "diffuse"})
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True)
class FileLight:
    """A light of a mesh file that is no surface.

    Attributes:
        name: as in the file.
        kind: ``type`` of a scene file's light: ``point``, ``spot`` or ``directional``.
        position: ``(3,)`` float64 in the file's space.
        direction: ``(3,)`` of unit length, where it shines.
        numbers: what a scene file's light of that type has beside its place.
    """

    name: str
    kind: str
    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    numbers: dict[str, float | tuple[float, ...]]


@dataclass(frozen=True)
class FileCamera:
    """A camera of a mesh file, for users to copy: a scene has its own.

    Attributes:
        name: as in the file.
        kind: ``type`` of a scene file's camera.
        matrix: ``(4, 4)`` from its own space, where it looks along -z with +y up, to the file's.
        film: what it sees, as keys of a scene file's camera.
    """

    name: str
    kind: str
    matrix: NDArray[np.float64]
    film: str


@dataclass(frozen=True)
class MeshPart:
    """Triangles that share a material.

    Attributes:
        name: the group's name in the file, may be empty.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, front side counter-clockwise.
        normals: ``(V, 3)`` float64 of unit length where the file has them, else None.
        uvs: ``(V, 2)`` float64, row 0 of an image at v = 0, or None.
        colors: ``(V, 3)`` float64, linear RGB >= 0, or None.
        material: the file's own, or None.
        ignored: what else of the file was left out, by name.
        lights: of the whole file; one of its parts has them.
        cameras: the same.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    normals: NDArray[np.float64] | None = None
    uvs: NDArray[np.float64] | None = None
    colors: NDArray[np.float64] | None = None
    material: FileMaterial | None = None
    ignored: tuple[str, ...] = ()
    lights: tuple[FileLight, ...] = ()
    cameras: tuple[FileCamera, ...] = ()


def checked(parts: list[MeshPart], path: Path) -> list[MeshPart]:
    """The parts, with indices and numbers checked, normals made unit and odd ones replaced.

    A zero normal becomes the smooth one of its vertex; a texture coordinate that is not finite becomes 0.

    Raises:
        AssetError: no triangle at all, more than :data:`MOST_PARTS` parts, a vertex, normal or colour that is not finite, an
            index out of range.
    """
    if len(parts) > MOST_PARTS:
        raise too_many(path)
    if not parts or all(len(part.faces) == 0 for part in parts):
        raise AssetError(path, "the mesh is empty (no face)")
    return [_checked(part, path) for part in parts if len(part.faces)]


def too_many(path: Path) -> AssetError:
    """What is said of a file of more than :data:`MOST_PARTS`."""
    return AssetError(path, f"has more than {MOST_PARTS} parts; at most so many are read")


def _checked(part: MeshPart, path: Path) -> MeshPart:
    label = f" of part {part.name}" if part.name else ""
    bad = np.flatnonzero(~(np.abs(part.vertices) <= _LARGEST).all(axis=1))  # NaN compares false
    if len(bad):
        raise AssetError(path, f"vertex {bad[0]}{label} is not finite: {part.vertices[bad[0]].tolist()}")
    count = len(part.vertices)
    bad = np.flatnonzero(((part.faces < 0) | (part.faces >= count)).any(axis=1))
    if len(bad):
        indices = part.faces[bad[0]].tolist()
        raise AssetError(path, f"face {bad[0]}{label} has an index outside 0..{count - 1}: {indices}")
    normals, uvs = part.normals, part.uvs
    if normals is not None:
        bad = np.flatnonzero(~np.isfinite(normals).all(axis=1))
        if len(bad):
            raise AssetError(path, f"normal {bad[0]}{label} is not finite: {normals[bad[0]].tolist()}")
        largest = np.abs(normals).max(axis=1, keepdims=True)
        zero = largest[:, 0] == 0
        scaled = normals / np.where(largest > 0, largest, 1.0)
        normals = scaled / np.where(zero, 1.0, np.linalg.norm(scaled, axis=1))[:, None]
        if zero.any():
            normals[zero] = smooth_normals(part.vertices, part.faces)[zero]
    if part.colors is not None:
        bad = np.flatnonzero(~((part.colors >= 0) & (part.colors <= _LARGEST)).all(axis=1))
        if len(bad):
            raise AssetError(path, f"colour {bad[0]}{label} is not finite and >= 0: {part.colors[bad[0]].tolist()}")
    if uvs is not None and not np.isfinite(uvs).all():
        uvs = np.where(np.isfinite(uvs), uvs, 0.0)
    return replace(part, normals=normals, uvs=uvs)


def corners_of_polygons(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Fans over polygons: ``(F, 3)`` positions into a flat list of corners, in polygon order.

    Args:
        starts: position of each polygon's first corner.
        counts: corners of each polygon, at least 3 (right for convex ones, as in most loaders).
    """
    fans = counts - 2
    owner = np.repeat(np.arange(len(counts)), fans)
    step = np.arange(len(owner)) - np.repeat(np.cumsum(fans) - fans, fans)
    first = starts[owner]
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def transformed(part: MeshPart, matrix: NDArray[np.float64]) -> MeshPart:
    """A part moved by an affine ``(4, 4)`` matrix; a mirroring one flips the winding, the front stays outside."""
    linear = matrix[:3, :3]
    normals, faces = part.normals, part.faces
    if normals is not None:
        cofactors = np.stack([np.cross(linear[(i + 1) % 3], linear[(i + 2) % 3]) for i in range(3)])
        normals = normals @ cofactors.T
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
        normals = None if normals is None else -normals  # cofactors carry the sign of the determinant
    return replace(
        part, vertices=part.vertices @ linear.T + matrix[:3, 3], faces=np.ascontiguousarray(faces), normals=normals
    )
