"""Mesh shapes of a description as parts; parts that touch each other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from torchpt.core.errors import AssetError, EnergyWarning, SceneError, warn_caller
from torchpt.physics.parts import Copy, Part
from torchpt.physics.shapes.base import Triangles
from torchpt.scene.formats.description import Description
from torchpt.scene.meshes import FileCamera, MeshPart, load_mesh
from torchpt.scene.meshes.mesh import displaced
from torchpt.scene.texture_loader import TextureLoader
from torchpt.spec.schema import ParsedParams

__all__ = ["MOST_FACES", "Mesh", "ignored", "mesh_of", "solid", "warn_of_coplanar_refraction"]


# ---- Meshes of a description: read, displaced, and without what has no area


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


def mesh_of(
    triangles: Triangles, key: str, description: Description, texture_loader: TextureLoader, *, materials: bool
) -> Mesh:
    """The triangles of a shape.

    Args:
        triangles: what the shape comes to.
        key: its dotted key.
        description: of the scene.
        texture_loader: of textures.
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
        from torchpt.scene.meshes.trimesh_objects import mesh_parts_of

        pieces, source = mesh_parts_of(triangles.object, materials=materials), "trimesh"
    else:
        assert triangles.vertices is not None and triangles.faces is not None
        arrays = (triangles.vertices, triangles.faces, triangles.normals, triangles.uvs)
        pieces, source = [MeshPart("", *arrays, None)], ""
    if triangles.displacement is not None:
        pieces = [_displaced(piece, triangles.displacement, key, texture_loader, source) for piece in pieces]
    return Mesh(pieces, source, triangles.flat)


def _displaced(
    piece: MeshPart, wish: ParsedParams, prefix: str, texture_loader: TextureLoader, source: str
) -> MeshPart:
    """A piece of a mesh under its displacement map."""
    key = f"{prefix}.displacement"
    if piece.uvs is None:
        problem = f"has no texture coordinates, which {key} needs"
        raise (
            AssetError(source, problem)
            if source
            else SceneError(key, "a mesh without uvs", "uvs beside it", texture_loader.file)
        )
    faces = len(piece.faces) * 4 ** wish["subdivisions"]
    if faces > MOST_FACES:
        expected = f"at most {MOST_FACES:,} faces ({faces:,} are asked for)"
        raise SceneError(f"{key}.subdivisions", wish["subdivisions"], expected, texture_loader.file)
    heights = texture_loader.values(wish["texture"], f"{key}.texture")
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


# ---- Refracting surfaces of two shapes that lie on each other: a ray meets one of them only, so it is in two media or in none


Array = NDArray[np.float64]
Integer = NDArray[np.int64]

#: How far two planes may lie apart and count as one, as a share of the scene's extent; and how far their normals may differ.
NEAR, ALIKE = 1e-6, 1e-5
#: Pairs of faces that are looked at, at most: this is no search for meshes that go through each other.
PAIRS = 2_000_000
#: Pairs that looking at one face costs as much as.
FACE = 100
#: The corners of a rectangle in its own space.
_SQUARE = np.array([[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]])
#: Corners on the rim of a disk in its own space: between two of them the rim is .0012 radii away.
_RIM = np.array([[[math.cos(angle), math.sin(angle), 0.0] for angle in np.arange(64) * math.tau / 64]])


@dataclass(frozen=True)
class _Faces:
    """Faces in the scene's space: polygons of as many corners as the part's have, ``(F, K, 3)``, and their shape."""

    shape: str
    corners: Array


def warn_of_coplanar_refraction(parts: Sequence[Part], copies: Sequence[Copy], file: str | None) -> None:
    """Look for flat faces of two refracting shapes that share a plane and overlap in it.

    Warns:
        EnergyWarning: two such shapes, once for each pair.
    """
    faces = list(_refracting(parts, copies))
    if len({one.shape for one in faces}) < 2:
        return
    points = np.concatenate([one.corners.reshape(-1, 3) for one in faces])
    centre, extent = 0.5 * (points.max(0) + points.min(0)), float(np.ptp(points, axis=0).max())
    if not extent > 0.0:
        return
    scaled = [_Faces(one.shape, (one.corners - centre) / extent) for one in faces]
    boxes = [(one.corners.min((0, 1)), one.corners.max((0, 1))) for one in scaled]
    told: set[tuple[str, str]] = set()
    for i, j in combinations(range(len(scaled)), 2):
        pair = scaled[i].shape, scaled[j].shape
        apart = (boxes[i][0] > boxes[j][1] + NEAR).any() or (boxes[j][0] > boxes[i][1] + NEAR).any()
        if pair[0] == pair[1] or pair in told or apart:
            continue
        if _overlap(scaled[i].corners, scaled[j].corners):
            told.add(pair)
            where = f"{file}: {pair[0]}" if file else pair[0]
            warn_caller(
                f"{where}: refracts and lies on {pair[1]}, which refracts too: rays meet one of the two surfaces only, and "
                "energy is not kept there; leave a gap between them",
                EnergyWarning,
            )


def _refracting(parts: Sequence[Part], copies: Sequence[Copy]) -> Iterator[_Faces]:
    known = {part.name: part for part in parts}
    for part in parts:
        if any(material.model.refracts for material in part.material.all()):
            pose = part.to_world if part.local is None else part.to_world @ part.local
            yield from _faces(part.name, part, pose)
    for copy in copies:
        if copy.of in known and any(material.model.refracts for material in copy.material.all()):
            yield from _faces(copy.name, known[copy.of], copy.to_world)


def _faces(name: str, part: Part, pose: Array) -> Iterator[_Faces]:
    """Those of a part under a pose, where it has flat ones."""
    if part.kind == "rectangle":
        yield _Faces(name, _moved(_SQUARE, pose))
    elif part.kind == "disk":  # caps of cylinders and cones too
        yield _Faces(name, _moved(_RIM, pose))
    elif part.vertices is not None and part.faces is not None:
        yield _Faces(name, _moved(part.vertices[part.faces], pose))


def _moved(corners: Array, pose: Array) -> Array:
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _planes(corners: Array) -> Array:
    """Unit normals and distances ``(F, 4)``; both sides of a plane are the same."""
    a, b, c = (corners[:, k * corners.shape[1] // 3] for k in range(3))  # of many corners, those that lie well apart
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    largest = np.take_along_axis(normals, np.abs(normals).argmax(1)[:, None], 1)
    normals = normals * np.where(largest < 0.0, -1.0, 1.0)
    return np.concatenate((normals, (normals * corners[:, 0]).sum(1, keepdims=True)), 1)


def _overlap(a: Array, b: Array) -> bool:
    """Whether any face of ``a`` and any of ``b`` lie in one plane and share some of its area."""
    low, high = np.maximum(a.min((0, 1)), b.min((0, 1))) - NEAR, np.minimum(a.max((0, 1)), b.max((0, 1))) + NEAR
    a, b = (x[((x.max(1) >= low) & (x.min(1) <= high)).all(1)] for x in (a, b))  # those within both boxes
    budget = PAIRS
    first, second = _planes(a), _planes(b)
    order = np.argsort(second[:, 3])
    b, second = b[order], second[order]
    starts = np.searchsorted(second[:, 3], first[:, 3] - NEAR)
    ends = np.searchsorted(second[:, 3], first[:, 3] + NEAR, "right")
    for k in np.flatnonzero(ends > starts):
        near = slice(int(starts[k]), int(ends[k]))
        budget -= near.stop - near.start + FACE
        alike = np.abs(second[near, :3] - first[k, :3]).max(1) <= ALIKE
        if alike.any() and _share_area(a[k], b[near][alike], first[k, :3]):
            return True
        if budget < 0:
            break
    return False


def _share_area(face: Array, others: Array, normal: Array) -> bool:
    """Whether a convex face ``(K, 3)`` and any of ``(M, L, 3)`` in its plane overlap: no side of either parts them."""
    axis = int(np.abs(normal).argmax())
    keep = [k for k in range(3) if k != axis]
    p, q = face[:, keep], others[:, :, keep]
    parted = np.zeros(len(q), bool)
    for sides in (np.broadcast_to(np.roll(p, -1, 0) - p, (len(q), *p.shape)), np.roll(q, -1, 1) - q):
        across = np.stack((-sides[..., 1], sides[..., 0]), -1)
        across = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-30)
        own, their = np.einsum("mkc,jc->mkj", across, p), np.einsum("mkc,mjc->mkj", across, q)
        gap = np.maximum(own.min(-1) - their.max(-1), their.min(-1) - own.max(-1))
        parted |= (gap >= -NEAR).any(1)
    return bool((~parted).any())
