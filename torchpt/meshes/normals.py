"""Smooth vertex normals of meshes that have none."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from torchpt.shapes import normals

__all__ = ["smooth_normals"]


def smooth_normals(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return unit vertex normals ``(V, 3)``, as :func:`torchpt.shapes.normals.smooth_normals` has them.

    A vertex without a face of positive area gets (0, 0, 1), so nothing is NaN; so does one whose faces face each other.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
    """
    columns = torch.from_numpy(np.ascontiguousarray(np.asarray(vertices, np.float64).T))
    found = normals.smooth_normals(columns, torch.from_numpy(np.asarray(faces, np.int64)), 1e-12).T.contiguous().numpy()
    found[~found.any(1)] = (0.0, 0.0, 1.0)
    return found
