"""Displacement maps: a mesh is subdivided when the scene is built, and its vertices move along their normals.

Vertices that lie at one place (on both sides of a seam of the texture, say) move together, so that no crack opens.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from torchpt.meshes import MeshPart, smooth_normals

__all__ = ["displaced", "subdivided"]

Rows = NDArray[np.float64]


def displaced(piece: MeshPart, heights: Callable[[Rows], Rows], subdivisions: int) -> MeshPart:
    """A mesh with its vertices moved along their normals.

    Args:
        piece: the mesh, with texture coordinates.
        heights: from texture coordinates ``(V, 2)`` to how far each vertex goes ``(V,)``, in the mesh's own space.
        subdivisions: how often every triangle is first cut into four.

    Returns:
        The mesh; its normals are those of its new shape, to be computed.
    """
    assert piece.uvs is not None
    normals = piece.normals if piece.normals is not None else smooth_normals(piece.vertices, piece.faces)
    mesh = replace(piece, normals=normals)
    for _ in range(subdivisions):
        mesh = subdivided(mesh)
    assert mesh.normals is not None and mesh.uvs is not None
    place, group = _places(mesh.vertices)
    direction = _averaged(_unit(mesh.normals), group, len(place))
    height = _averaged(heights(mesh.uvs)[:, None], group, len(place))
    vertices = place + _unit(direction) * height
    # One vertex a place, so that the new normals are smooth across seams; texture coordinates stay with their own.
    joined = replace(mesh, vertices=vertices, faces=group[mesh.faces], normals=None, uvs=None, colors=None)
    smooth = smooth_normals(joined.vertices, joined.faces)
    return replace(mesh, vertices=vertices[group], normals=smooth[group])


def subdivided(mesh: MeshPart) -> MeshPart:
    """A mesh with every triangle cut into four at the middles of its edges; whatever the vertices have is interpolated."""
    a, b, c = mesh.faces.T
    ends = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([b, c], 1), np.stack([c, a], 1)]), axis=1)
    # As one number each, which sorts many times faster than pairs.
    keys, which = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(keys, len(mesh.vertices)), 1)
    ab, bc, ca = which.reshape(3, -1) + len(mesh.vertices)
    faces = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])

    def extended(rows: Rows | None) -> Rows | None:
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


def _places(vertices: Rows) -> tuple[Rows, NDArray[np.int64]]:
    """Distinct positions, and which of them each vertex has."""
    bits = (np.ascontiguousarray(vertices) + 0.0).view(np.uint64)  # + 0 makes -0 and 0 one
    mixed = bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
    mixed ^= mixed >> np.uint64(29)
    # Any vertex of a place will do for it: asked for the first ones, `unique` would have to sort stably, which is far slower.
    keys, group = np.unique(mixed.sum(1) * np.uint64(0xBF58476D1CE4E5B9), return_inverse=True)
    place, group = np.empty((len(keys), 3)), group.reshape(-1)
    place[group] = vertices
    if not np.array_equal(place[group], vertices):  # two places of one hash: once in 2^64 / V^2 meshes
        place, group = np.unique(vertices, axis=0, return_inverse=True)
    return place, group.reshape(-1)


def _averaged(rows: Rows, group: NDArray[np.int64], count: int) -> Rows:
    """Means ``(count, C)`` over groups."""
    total = np.stack([np.bincount(group, column, minlength=count) for column in rows.T], 1)
    return total / np.bincount(group, minlength=count)[:, None]


def _unit(rows: Rows) -> Rows:
    length = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(length > 0, length, 1.0)
