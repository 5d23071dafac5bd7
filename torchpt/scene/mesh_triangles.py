"""Load the triangles of mesh shapes, and warn of refracting shapes that touch.

:mod:`torchpt.scene.shapes` loads meshes by this module; :func:`torchpt.scene.build.build_parts` calls the warning once all
parts exist.
"""

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

__all__ = ["MOST_FACES", "Mesh", "faces_with_area", "ignored_features", "mesh_of", "warn_of_coplanar_refraction"]


# ---- Triangles of a shape: reading, displacement, removal of faces without area


#: Most faces of a displaced mesh: its arrays take a GiB or more.
MOST_FACES = 20_000_000
#: Smallest squared area of a parallelogram whose longest edge coordinate is 1: an angle of 1e-12 between the edges of a face.
_SMALLEST_SQUARE = 1e-24


@dataclass(frozen=True)
class Mesh:
    """Triangles of a shape.

    Attributes:
        pieces: the parts, one for each material; a *piece* becomes a :class:`~torchpt.physics.parts.Part` of the scene.
        source: path of the file; "trimesh" for an object, "" for arrays.
        flat: True to shade with face normals.
    """

    pieces: list[MeshPart]
    source: str
    flat: bool


def mesh_of(
    triangles: Triangles, key: str, description: Description, texture_loader: TextureLoader, *, materials: bool
) -> Mesh:
    """Load the triangles of a shape.

    Args:
        triangles: the shape's file, object or arrays.
        key: its dotted key.
        description: the scene's.
        texture_loader: opens textures.
        materials: True to read the file's own materials.

    Raises:
        SceneError: a displacement of a mesh without texture coordinates, or of too many faces.
        AssetError: a missing or malformed file.
    """
    if triangles.path is not None:
        path = description.resolve(triangles.path, f"{key}.path")
        pieces, source = load_mesh(path, materials=materials, index=triangles.shape_index), str(path)
    elif isinstance(triangles.object, tuple):
        pieces, source = list(triangles.object), "trimesh"  # parts that `from_trimesh` has made already
    elif triangles.object is not None:
        from torchpt.scene.meshes.trimesh_objects import mesh_parts_of

        pieces, source = mesh_parts_of(triangles.object, materials=materials), "trimesh"
    else:
        assert triangles.vertices is not None and triangles.faces is not None
        arrays = (triangles.vertices, triangles.faces, triangles.normals, triangles.uvs, triangles.colors)
        pieces, source = [MeshPart("", *arrays)], ""
    if triangles.displacement is not None:
        pieces = [_displaced(piece, triangles.displacement, key, texture_loader, source) for piece in pieces]
    return Mesh(pieces, source, triangles.flat)


def _displaced(
    piece: MeshPart, displacement: ParsedParams, prefix: str, texture_loader: TextureLoader, source: str
) -> MeshPart:
    """Apply a displacement map to a part of a mesh."""
    key = f"{prefix}.displacement"
    if piece.uvs is None:
        problem = f"has no texture coordinates, which {key} needs"
        raise (
            AssetError(source, problem)
            if source
            else SceneError(key, "a mesh without uvs", "uvs beside it", texture_loader.file)
        )
    faces = len(piece.faces) * 4 ** displacement["subdivisions"]  # each subdivision splits a face into four
    if faces > MOST_FACES:
        expected = f"at most {MOST_FACES:,} faces ({faces:,} are asked for)"
        raise SceneError(f"{key}.subdivisions", displacement["subdivisions"], expected, texture_loader.file)
    heights = texture_loader.values(displacement["texture"], f"{key}.texture")
    return displaced(piece, lambda uvs: displacement["scale"] * heights(uvs), displacement["subdivisions"])


def ignored_features(piece: MeshPart, pose: np.ndarray) -> tuple[str, ...]:
    """Return the unsupported features of a part by name, and its file's cameras as blocks of a scene file."""
    own = piece.material
    cameras = [_camera_text(camera, pose) for camera in piece.cameras]
    return (*piece.ignored, *cameras, *(() if own is None else own.ignored))


def _camera_text(camera: FileCamera, pose: np.ndarray) -> str:
    """Return a mesh file's camera as text of a camera block, transformed by ``pose``."""
    with np.errstate(over="ignore", invalid="ignore"):
        matrix = pose @ camera.matrix
        origin, ahead, up = matrix[:3, 3], -matrix[:3, 2], matrix[:3, 1]
        target, up = (origin + ahead / np.linalg.norm(ahead), up / np.linalg.norm(up))
    places = {"origin": origin, "target": target, "up": up}
    rows = ", ".join(f"{key}: [{', '.join(f'{x + 0.0:.6g}' for x in value)}]" for key, value in places.items())
    return f"camera {camera.name}: {{type: {camera.kind}, {rows}, {camera.film_text}}}"


def faces_with_area(piece: MeshPart, pose: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the faces ``(F, 3)`` that have an area under ``pose (4, 4)``, and the number of the others."""
    columns = pose[:3, :3] @ piece.vertices.T  # (3, V); a translation changes no area
    p0, p1, p2 = (columns[:, piece.faces[:, k]] for k in range(3))
    first, second = p1 - p0, p2 - p0
    # Relative to the longest edge, so that the test does not depend on a mesh's size.
    longest = np.maximum(np.abs(first), np.abs(second)).max(0)
    safe = np.where(longest > 0, longest, 1.0)
    (ax, ay, az), (bx, by, bz) = first / safe, second / safe
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    kept = (longest > 0) & (square > _SMALLEST_SQUARE)
    return np.ascontiguousarray(piece.faces[kept]), int((~kept).sum())


# ---- Coplanar refracting faces of two shapes: a ray hits only one of them and so tracks the wrong medium


Array = NDArray[np.float64]

#: Largest distance of two planes that count as one, relative to the scene's extent: some times the rounding of float32.
MAX_PLANE_DISTANCE = 1e-6
#: Largest difference, by component, of the unit normals of two planes that count as one.
MAX_NORMAL_DIFFERENCE = 1e-5
#: Most pairs of faces that are tested for two parts, so that the warning costs little of a load.
MAX_PAIRS = 2_000_000
#: The loop over faces takes as long for a face as the test of so many pairs.
PAIRS_PER_FACE = 100
#: Corners of a rectangle in its own space.
_SQUARE = np.array([[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]])
#: Polygon for a disk in its own space; it deviates from the circle by at most 0.0012 radii.
_RIM = np.array([[[math.cos(angle), math.sin(angle), 0.0] for angle in np.arange(64) * math.tau / 64]])


@dataclass(frozen=True)
class _Faces:
    """Polygons ``(F, K, 3)`` of a part in the scene's space, and the name of its shape."""

    shape: str
    corners: Array


def warn_of_coplanar_refraction(parts: Sequence[Part], copies: Sequence[Copy], file: str | None) -> None:
    """Warn of refracting shapes with flat faces that are coplanar and overlap.

    Warns:
        EnergyWarning: once for each pair of such shapes.
    """
    faces = list(_refracting_faces(parts, copies))
    if len({one.shape for one in faces}) < 2:
        return
    points = np.concatenate([one.corners.reshape(-1, 3) for one in faces])
    centre, extent = 0.5 * (points.max(0) + points.min(0)), float(np.ptp(points, axis=0).max())
    if not extent > 0.0:
        return
    scaled = [
        _Faces(one.shape, (one.corners - centre) / extent) for one in faces
    ]  # in a box of side 1 about the origin
    boxes = [(one.corners.min((0, 1)), one.corners.max((0, 1))) for one in scaled]
    warned: set[tuple[str, str]] = set()
    for i, j in combinations(range(len(scaled)), 2):
        shape, other = pair = scaled[i].shape, scaled[j].shape
        (low_i, high_i), (low_j, high_j) = boxes[i], boxes[j]
        apart = (low_i > high_j + MAX_PLANE_DISTANCE).any() or (low_j > high_i + MAX_PLANE_DISTANCE).any()
        if shape == other or pair in warned or apart:
            continue
        if _overlap(scaled[i].corners, scaled[j].corners):
            warned.add(pair)
            where = f"{file}: {shape}" if file else shape
            warn_caller(
                f"{where}: refracts and lies on {other}, which refracts too: rays meet one of the two surfaces only, and "
                "energy is not kept there; leave a gap between them",
                EnergyWarning,
            )


def _refracting_faces(parts: Sequence[Part], copies: Sequence[Copy]) -> Iterator[_Faces]:
    """Yield the flat faces of all parts and copies that have a refracting material."""
    part_by_name = {part.name: part for part in parts}
    for part in parts:
        if any(material.model.refracts for material in part.material.with_inner()):
            pose = part.to_world if part.part_to_shape is None else part.to_world @ part.part_to_shape
            yield from _faces(part.name, part, pose)
    for copy in copies:
        if copy.of in part_by_name and any(material.model.refracts for material in copy.material.with_inner()):
            yield from _faces(copy.name, part_by_name[copy.of], copy.to_world)


def _faces(name: str, part: Part, pose: Array) -> Iterator[_Faces]:
    """Yield the flat faces of a part under a pose."""
    if part.kind == "rectangle":
        yield _Faces(name, _moved(_SQUARE, pose))
    elif part.kind == "disk":  # also the caps of cylinders and cones
        yield _Faces(name, _moved(_RIM, pose))
    elif part.vertices is not None and part.faces is not None:
        yield _Faces(name, _moved(part.vertices[part.faces], pose))


def _moved(corners: Array, pose: Array) -> Array:
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _planes(corners: Array) -> Array:
    """Return unit normals and distances from the origin ``(F, 4)`` of the planes of faces ``(F, K, 3)``.

    The largest component of a normal is made positive, so that both sides of a plane give the same numbers.
    """
    a, b, c = (corners[:, k * corners.shape[1] // 3] for k in range(3))  # corners far apart from each other
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    largest = np.take_along_axis(normals, np.abs(normals).argmax(1)[:, None], 1)
    normals = normals * np.where(largest < 0.0, -1.0, 1.0)
    return np.concatenate((normals, (normals * corners[:, 0]).sum(1, keepdims=True)), 1)


def _overlap(a: Array, b: Array) -> bool:
    """Return True where a face of ``a (F, K, 3)`` and one of ``b (G, L, 3)`` are coplanar and overlap.

    Faces of ``b`` are sorted by the distance of their plane, so that those near a face of ``a`` are a slice.
    """
    low = np.maximum(a.min((0, 1)), b.min((0, 1))) - MAX_PLANE_DISTANCE
    high = np.minimum(a.max((0, 1)), b.max((0, 1))) + MAX_PLANE_DISTANCE
    # Faces within both boxes.
    a, b = (faces[((faces.max(1) >= low) & (faces.min(1) <= high)).all(1)] for faces in (a, b))
    budget = MAX_PAIRS
    a_planes, b_planes = _planes(a), _planes(b)
    order = np.argsort(b_planes[:, 3])
    b, b_planes = b[order], b_planes[order]
    starts = np.searchsorted(b_planes[:, 3], a_planes[:, 3] - MAX_PLANE_DISTANCE)
    ends = np.searchsorted(b_planes[:, 3], a_planes[:, 3] + MAX_PLANE_DISTANCE, "right")
    for k in np.flatnonzero(ends > starts):
        near = slice(int(starts[k]), int(ends[k]))
        budget -= near.stop - near.start + PAIRS_PER_FACE
        parallel = np.abs(b_planes[near, :3] - a_planes[k, :3]).max(1) <= MAX_NORMAL_DIFFERENCE
        if parallel.any() and _overlaps_any(a[k], b[near][parallel], a_planes[k, :3]):
            return True
        if budget < 0:  # rather no warning than a long load
            break
    return False


def _overlaps_any(face: Array, others: Array, normal: Array) -> bool:
    """Return True where a convex face ``(K, 3)`` overlaps any of ``(M, L, 3)`` in its plane (separating axis test).

    Two convex polygons are apart if along the normal of some side of either their projections do not overlap.
    """
    axis = int(np.abs(normal).argmax())
    keep = [k for k in range(3) if k != axis]  # project to the coordinate plane that the faces are most parallel to
    p, q = face[:, keep], others[:, :, keep]  # (K, 2), (M, L, 2)
    separated = np.zeros(len(q), bool)
    for sides in (np.broadcast_to(np.roll(p, -1, 0) - p, (len(q), *p.shape)), np.roll(q, -1, 1) - q):
        across = np.stack((-sides[..., 1], sides[..., 0]), -1)
        across = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-30)  # a side may have length 0
        # m: other faces, k: sides, j: corners, c: coordinates.
        own, their = np.einsum("mkc,jc->mkj", across, p), np.einsum("mkc,mjc->mkj", across, q)
        gap = np.maximum(own.min(-1) - their.max(-1), their.min(-1) - own.max(-1))
        separated |= (gap >= -MAX_PLANE_DISTANCE).any(1)
    return bool((~separated).any())
