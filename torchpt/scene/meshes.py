"""Meshes of a description: read, displaced, and without what has no area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchpt.errors import AssetError, SceneError
from torchpt.format.description import Description
from torchpt.meshes import FileCamera, MeshPart, load_mesh
from torchpt.meshes.displacement import displaced
from torchpt.scene.texels import Opener
from torchpt.shapes.base import Triangles
from torchpt.spec.declared import Described

__all__ = ["MOST_FACES", "Mesh", "ignored", "mesh_of", "solid"]

#: Faces that a displaced mesh may come to.
MOST_FACES = 20_000_000


@dataclass(frozen=True)
class Mesh:
    """Triangles that have been read.

    Attributes:
        pieces: one for each material.
        source: the file, or "".
        flat: whether they are shaded flat, whatever normals there are.
    """

    pieces: list[MeshPart]
    source: str
    flat: bool


def mesh_of(triangles: Triangles, key: str, description: Description, opener: Opener, *, materials: bool) -> Mesh:
    """The triangles of a shape.

    Args:
        triangles: what the shape comes to.
        key: its dotted key.
        description: of the scene.
        opener: of textures.
        materials: whether to read the file's own materials.

    Raises:
        SceneError: a displacement that cannot be.
        AssetError: a file that is missing or malformed.
    """
    if triangles.path is not None:
        path = description.resolve(triangles.path, f"{key}.path")
        pieces, source = load_mesh(path, materials=materials), str(path)
    elif isinstance(triangles.object, tuple):
        pieces, source = list(triangles.object), "trimesh"
    elif triangles.object is not None:
        from torchpt.meshes.trimesh_parts import mesh_parts_of

        pieces, source = mesh_parts_of(triangles.object, materials=materials), "trimesh"
    else:
        assert triangles.vertices is not None and triangles.faces is not None
        arrays = (triangles.vertices, triangles.faces, triangles.normals, triangles.uvs)
        pieces, source = [MeshPart("", *arrays, None)], ""
    if triangles.displacement is not None:
        pieces = [_displaced(piece, triangles.displacement, key, opener, source) for piece in pieces]
    return Mesh(pieces, source, triangles.flat)


def _displaced(piece: MeshPart, wish: Described, prefix: str, opener: Opener, source: str) -> MeshPart:
    """A piece of a mesh under its displacement map."""
    key = f"{prefix}.displacement"
    if piece.uvs is None:
        problem = f"has no texture coordinates, which {key} needs"
        raise (
            AssetError(source, problem)
            if source
            else SceneError(key, "a mesh without uvs", "uvs beside it", opener.file)
        )
    faces = len(piece.faces) * 4 ** wish["subdivisions"]
    if faces > MOST_FACES:
        expected = f"at most {MOST_FACES:,} faces ({faces:,} are asked for)"
        raise SceneError(f"{key}.subdivisions", wish["subdivisions"], expected, opener.file)
    heights = opener.values(wish["texture"], f"{key}.texture")
    return displaced(piece, lambda uvs: wish["scale"] * heights(uvs), wish["subdivisions"])


def ignored(piece: MeshPart, pose: np.ndarray) -> tuple[str, ...]:
    """What of a mesh file is not used; cameras as a scene file would have them."""
    own = piece.material
    cameras = [_as_written(camera, pose) for camera in piece.cameras]
    return (*piece.ignored, *cameras, *(() if own is None else own.ignored))


def _as_written(camera: FileCamera, pose: np.ndarray) -> str:
    """A mesh file's camera as the block of a scene file, mesh under ``pose``."""
    with np.errstate(over="ignore", invalid="ignore"):
        matrix = pose @ camera.matrix
        origin, ahead, up = matrix[:3, 3], -matrix[:3, 2], matrix[:3, 1]
        target, up = (origin + ahead / np.linalg.norm(ahead), up / np.linalg.norm(up))
    places = {"origin": origin, "target": target, "up": up}
    rows = ", ".join(f"{key}: [{', '.join(f'{x + 0.0:.6g}' for x in value)}]" for key, value in places.items())
    return f"camera {camera.name}: {{type: {camera.kind}, {rows}, {camera.film}}}"


def solid(piece: MeshPart, pose: np.ndarray) -> tuple[np.ndarray, int]:
    """Faces that have an area, and how many do not."""
    columns = pose[:3, :3] @ piece.vertices.T
    p0, p1, p2 = (columns[:, piece.faces[:, k]] for k in range(3))
    first, second = p1 - p0, p2 - p0
    # Relative to the longest edge, so that neither tiny nor huge meshes are mistaken for degenerate ones.
    longest = np.maximum(np.abs(first), np.abs(second)).max(0)
    safe = np.where(longest > 0, longest, 1.0)
    (ax, ay, az), (bx, by, bz) = first / safe, second / safe
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    kept = (longest > 0) & (square > 1e-24)
    return np.ascontiguousarray(piece.faces[kept]), int((~kept).sum())
