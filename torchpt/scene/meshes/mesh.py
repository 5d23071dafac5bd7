"""Records of what mesh files hold, their validation, and smooth normals, polygon fans and displacement of meshes.

Readers of mesh formats return :class:`MeshPart`, in NumPy and float64, row by row: ``(V, 3)`` for V vertices, ``(F, 3)`` for F
faces of three vertex indices. :func:`checked` is applied to all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.core.errors import AssetError, EmptyMeshError
from torchpt.physics.shapes import normals

__all__ = [
    "COLORED",
    "MAX_UNPACKED",
    "MOST_PARTS",
    "FileCamera",
    "FileLight",
    "FileMaterial",
    "MeshPart",
    "checked",
    "displaced",
    "polygon_fans",
    "smooth_normals",
    "subdivided",
    "too_many_parts",
    "transformed",
]


# ---- Smooth vertex normals of meshes that have none


#: Sums of a vertex's face normals, weighted by angle, that are no longer than this count as zero: they are rounding.
_SHORTEST_SUM = 1e-12


def smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit vertex normals ``(V, 3)``, computed by :func:`torchpt.physics.shapes.normals.smooth_normals`.

    A vertex whose normals sum to zero (no face with an area, or faces of opposite normals) gets (0, 0, 1).

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
    """
    columns = torch.from_numpy(np.ascontiguousarray(np.asarray(vertices, np.float64).T))  # (3, V)
    found = normals.smooth_normals(columns, torch.from_numpy(np.asarray(faces, np.int64)), _SHORTEST_SUM)
    found = found.T.contiguous().numpy()
    found[~found.any(1)] = (0.0, 0.0, 1.0)
    return found


# ---- Records that mesh readers return, and the checks that all formats share


#: Most parts of one file: groups of an OBJ file, primitives of all nodes of a glTF file.
MOST_PARTS = 100_000
#: Most bytes that the compressed parts of one file may decompress to.
MAX_UNPACKED = 2**30

#: Largest number of a vertex or colour: those of scenes become float32.
_LARGEST = float(np.finfo(np.float32).max)

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class FileMaterial:
    """A material of a mesh file.

    Attributes:
        name: as in the file, cut to what errors can print.
        material: the block of a scene file: ``type``, parameters, textures inline with absolute paths or
            `EncodedImage`.
        ignored: unsupported features of the material, by the file's names.
    """

    name: str
    material: dict[str, Any] = field(default_factory=lambda: {"type": "diffuse"})
    ignored: tuple[str, ...] = ()


#: The material of a mesh whose vertices have colours, in formats without materials.
COLORED = FileMaterial("vertex colors", {"type": "diffuse", "reflectance": {"type": "vertex_color"}})


@dataclass(frozen=True)
class FileLight:
    """A light of a mesh file other than an emissive surface.

    Attributes:
        name: as in the file.
        kind: ``type`` of a scene file's light: ``point``, ``spot`` or ``directional``.
        position: ``(3,)`` float64 in the file's space.
        direction: ``(3,)`` unit vector away from the light.
        numbers: its parameters in a scene file, without position and direction.
    """

    name: str
    kind: str
    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    numbers: dict[str, float | tuple[float, ...]]


@dataclass(frozen=True)
class FileCamera:
    """A camera of a mesh file. It is only reported, for users to copy into their scene.

    Attributes:
        name: as in the file.
        kind: ``type`` of a scene file's camera.
        matrix: ``(4, 4)`` from its own space, where it looks along -z with +y up, to the file's.
        film_text: its field of view or width, as text of a scene file's camera block.
    """

    name: str
    kind: str
    matrix: NDArray[np.float64]
    film_text: str


@dataclass(frozen=True)
class MeshPart:
    """Triangles of a mesh file that share a material.

    Attributes:
        name: the group's name in the file; may be empty.
        vertices: ``(V, 3)`` float64.
        faces: ``(F, 3)`` int64, front side counter-clockwise.
        normals: ``(V, 3)`` float64 of unit length where the file has them, else None.
        uvs: ``(V, 2)`` float64, row 0 of an image at v = 0, or None.
        colors: ``(V, 3)`` float64, linear RGB >= 0, or None.
        material: the file's own, or None.
        ignored: further unsupported features of the file, by name.
        lights: lights of the whole file; only one of its parts has them.
        cameras: cameras of the whole file; only one of its parts has them.
        flat: the file asks for face normals.
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
    flat: bool = False


def checked(parts: list[MeshPart], path: Path) -> list[MeshPart]:
    """Return the parts that have faces, with indices and numbers checked and normals normalized.

    A zero normal becomes the smooth one of its vertex; a texture coordinate that is not finite becomes 0.

    Raises:
        EmptyMeshError: no triangle at all.
        AssetError: more than :data:`MOST_PARTS` parts, a vertex, normal or colour that is not finite, an
            index out of range.
    """
    if len(parts) > MOST_PARTS:
        raise too_many_parts(path)
    if not parts or all(len(part.faces) == 0 for part in parts):
        raise EmptyMeshError(path, "the mesh is empty (no face)")
    return [_checked(part, path) for part in parts if len(part.faces)]


def too_many_parts(path: Path) -> AssetError:
    """Return the error for a file of more than :data:`MOST_PARTS` parts."""
    return AssetError(path, f"has more than {MOST_PARTS} parts; at most so many are read")


def _checked(part: MeshPart, path: Path) -> MeshPart:
    label = f" of part {part.name}" if part.name else ""  # for errors
    # Sums over rows of three numbers take numpy long: rows are looked at only where something is wrong.
    if not (np.abs(part.vertices) <= _LARGEST).all():  # NaN compares false
        bad = np.flatnonzero(~(np.abs(part.vertices) <= _LARGEST).all(axis=1))
        raise AssetError(path, f"vertex {bad[0]}{label} is not finite: {part.vertices[bad[0]].tolist()}")
    count = len(part.vertices)
    if ((part.faces < 0) | (part.faces >= count)).any():
        bad = np.flatnonzero(((part.faces < 0) | (part.faces >= count)).any(axis=1))
        indices = part.faces[bad[0]].tolist()
        raise AssetError(path, f"face {bad[0]}{label} has an index outside 0..{count - 1}: {indices}")
    normals, uvs = part.normals, part.uvs
    if normals is not None:
        if not np.isfinite(normals).all():
            bad = np.flatnonzero(~np.isfinite(normals).all(axis=1))
            raise AssetError(path, f"normal {bad[0]}{label} is not finite: {normals[bad[0]].tolist()}")
        # Divided by the largest component first, whose square could overflow.
        x, y, z = np.abs(normals).T
        largest = np.maximum(np.maximum(x, y), z)
        zero = largest == 0
        scaled = normals / np.where(zero, 1.0, largest)[:, None]
        x, y, z = (scaled * scaled).T
        normals = scaled / np.where(zero, 1.0, np.sqrt(x + y + z))[:, None]
        if zero.any():
            normals[zero] = smooth_normals(part.vertices, part.faces)[zero]
    if part.colors is not None:
        if not ((part.colors >= 0) & (part.colors <= _LARGEST)).all():
            bad = np.flatnonzero(~((part.colors >= 0) & (part.colors <= _LARGEST)).all(axis=1))
            raise AssetError(path, f"colour {bad[0]}{label} is not finite and >= 0: {part.colors[bad[0]].tolist()}")
    if uvs is not None and not np.isfinite(uvs).all():
        uvs = np.where(np.isfinite(uvs), uvs, 0.0)
    return replace(part, normals=normals, uvs=uvs)


def polygon_fans(starts: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Split polygons into fans of triangles: ``(F, 3)`` indices into the flat list of corners, in the order of polygons.

    Args:
        starts: index of each polygon's first corner.
        counts: number of corners of each polygon, at least 3. Fans are right for convex polygons, as in most loaders.
    """
    fans = counts - 2  # triangles of each polygon
    polygon = np.repeat(np.arange(len(counts)), fans)  # (F,) polygon of each triangle
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(fans) - fans, fans)  # (F,) index of a triangle in its polygon
    first = starts[polygon]
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def transformed(part: MeshPart, matrix: NDArray[np.float64]) -> MeshPart:
    """Return a part transformed by an affine ``(4, 4)`` matrix; a mirroring one flips the winding, so fronts stay fronts."""
    linear = matrix[:3, :3]
    normals, faces = part.normals, part.faces
    if normals is not None:
        # Normals transform by the cofactor matrix: the inverse transposed, times the determinant.
        cofactors = np.stack([np.cross(linear[(i + 1) % 3], linear[(i + 2) % 3]) for i in range(3)])
        normals = normals @ cofactors.T
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
        normals = None if normals is None else -normals  # cofactors carry the sign of the determinant
    return replace(
        part, vertices=part.vertices @ linear.T + matrix[:3, 3], faces=np.ascontiguousarray(faces), normals=normals
    )


# ---- Displacement maps: subdivide a mesh when the scene is built, and move its vertices along their normals
#
# Vertices of the same position (on both sides of a texture seam, say) move together, so that no crack opens.


#: ``(V, C)``: a row for each vertex.
Rows = NDArray[np.float64]


def displaced(piece: MeshPart, heights: Callable[[Rows], Rows], subdivisions: int) -> MeshPart:
    """Return a mesh with its vertices moved along their normals, and the normals of its new shape.

    Args:
        piece: the mesh, with texture coordinates.
        heights: returns displacements ``(V,)`` in the mesh's own space for texture coordinates ``(V, 2)``.
        subdivisions: number of times that every triangle is first split into four.
    """
    assert piece.uvs is not None
    normals = piece.normals if piece.normals is not None else smooth_normals(piece.vertices, piece.faces)
    mesh = replace(piece, normals=normals)
    for _ in range(subdivisions):
        mesh = subdivided(mesh)
    assert mesh.normals is not None and mesh.uvs is not None
    positions, group = _unique_positions(mesh.vertices)
    direction = _averaged(_unit(mesh.normals), group, len(positions))
    height = _averaged(heights(mesh.uvs)[:, None], group, len(positions))
    vertices = positions + _unit(direction) * height
    # One vertex per position, so that the new normals are smooth across texture seams.
    joined = replace(mesh, vertices=vertices, faces=group[mesh.faces], normals=None, uvs=None, colors=None)
    smooth = smooth_normals(joined.vertices, joined.faces)
    return replace(mesh, vertices=vertices[group], normals=smooth[group])


def subdivided(mesh: MeshPart) -> MeshPart:
    """Return a mesh with every triangle split into four at its edges' midpoints; vertex attributes are interpolated."""
    a, b, c = mesh.faces.T  # (F,) vertices of each face; below ab, bc and ca are the midpoints of the edges
    ends = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([b, c], 1), np.stack([c, a], 1)]), axis=1)
    # Edges as single numbers sort many times faster than pairs.
    keys, edge_of_side = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(keys, len(mesh.vertices)), 1)
    ab, bc, ca = edge_of_side.reshape(3, -1) + len(mesh.vertices)  # midpoints come after the old vertices
    faces = np.concatenate([np.stack(triple, 1) for triple in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])

    def extended(rows: Rows | None) -> Rows | None:
        """Return an attribute of old vertices and midpoints."""
        return None if rows is None else np.concatenate([rows, 0.5 * (rows[edges[:, 0]] + rows[edges[:, 1]])])

    normals = extended(mesh.normals)
    vertices = extended(mesh.vertices)
    assert vertices is not None
    return replace(
        mesh,
        vertices=vertices,
        faces=faces,
        normals=None if normals is None else _unit(normals),
        uvs=extended(mesh.uvs),
        colors=extended(mesh.colors),
    )


def _unique_positions(vertices: Rows) -> tuple[Rows, NDArray[np.int64]]:
    """Return the distinct positions, and for each vertex the index of its position.

    Positions are found by a 64-bit hash (multipliers of xxHash and of SplitMix64), since sorting rows is many times slower.
    """
    bits = (np.ascontiguousarray(vertices) + 0.0).view(np.uint64)  # + 0 makes -0 and 0 one
    mixed = bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed ^= mixed >> np.uint64(29)
    # No `return_index`: `unique` would sort stably for it, which is far slower.
    keys, group = np.unique(mixed.sum(1) * np.uint64(0xBF58476D1CE4E5B9), return_inverse=True)
    positions, group = np.empty((len(keys), 3)), group.reshape(-1)
    positions[group] = vertices
    if not np.array_equal(positions[group], vertices):  # a hash collision: one in 2^64 / V^2 meshes
        positions, group = np.unique(vertices, axis=0, return_inverse=True)
    return positions, group.reshape(-1)


def _averaged(rows: Rows, group: NDArray[np.int64], count: int) -> Rows:
    """Return the means ``(count, C)`` of rows by group."""
    total = np.stack([np.bincount(group, column, minlength=count) for column in rows.T], 1)
    return total / np.bincount(group, minlength=count)[:, None]


def _unit(rows: Rows) -> Rows:
    """Return rows of length 1; zeros stay."""
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(length > 0, length, 1.0)
