"""Smooth vertex normals from triangles alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["smooth_normals"]


def smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Unit vertex normals ``(V, 3)``: face normals weighted by the angle at the vertex, as Mitsuba computes them.

    Thuermer and Wuethrich, *Computing Vertex Normals from Polygonal Facets*, JGT 3(1), 1998. A vertex without a face
    of positive area gets (0, 0, 1), so nothing is NaN. Independent of scale.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
    """
    corners = vertices[faces]  # (F, 3, 3): face, corner, coordinate
    corners = corners - corners[:, :1]
    size = np.abs(corners).max(axis=(1, 2), keepdims=True)
    corners = corners / np.where(size > 0, size, 1.0)
    face_normal = np.cross(corners[:, 1], corners[:, 2])
    length = np.linalg.norm(face_normal, axis=1)
    face_normal /= np.where(length > 0, length, 1.0)[:, None]
    total = np.zeros_like(vertices, dtype=np.float64)
    for corner in range(3):
        a = corners[:, (corner + 1) % 3] - corners[:, corner]
        b = corners[:, (corner + 2) % 3] - corners[:, corner]
        angle = np.arctan2(length, np.einsum("ij,ij->i", a, b))  # |a x b| is the same at every corner
        weighted = np.where(length > 0, angle, 0.0)[:, None] * face_normal
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], weighted[:, axis], minlength=len(vertices))
    norm = np.linalg.norm(total, axis=1)
    total[norm <= 1e-12] = (0.0, 0.0, 1.0)  # weights are angles: a sum this small is cancellation
    return total / np.where(norm > 1e-12, norm, 1.0)[:, None]
