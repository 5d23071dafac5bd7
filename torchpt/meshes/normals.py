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
    columns = np.ascontiguousarray(
        np.asarray(vertices, np.float64).T
    )  # by coordinate: several times faster than by row
    first, second, third = (columns[:, faces[:, k]] for k in range(3))
    second, third = second - first, third - first
    size = np.maximum(np.abs(second), np.abs(third)).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    second, third = second / size, third / size
    corners = (np.zeros_like(second), second, third)
    face_normal = _cross(second, third)
    length = np.sqrt(_dot(face_normal, face_normal))
    face_normal /= np.where(length > 0, length, 1.0)
    total = np.zeros_like(columns)
    for corner in range(3):
        a = corners[(corner + 1) % 3] - corners[corner]
        b = corners[(corner + 2) % 3] - corners[corner]
        angle = np.arctan2(length, _dot(a, b))  # |a x b| is the same at every corner
        weight = np.where(length > 0, angle, 0.0)
        for axis in range(3):
            total[axis] += np.bincount(faces[:, corner], weight * face_normal[axis], minlength=len(vertices))
    norm = np.sqrt(_dot(total, total))
    total[:, norm <= 1e-12] = np.array([[0.0], [0.0], [1.0]])  # weights are angles: a sum this small is cancellation
    return np.ascontiguousarray((total / np.where(norm > 1e-12, norm, 1.0)).T)


def _dot(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))
