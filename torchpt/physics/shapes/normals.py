"""Smooth vertex normals of a mesh, differentiable in its vertices.

Weighted by the angle at each corner, as Mitsuba does (Thuermer and Wuethrich, *Computing Vertex Normals from Polygonal
Facets*, 1998); the angle between unit edges is ``2 atan2(|a - b|, |a + b|)``, which is accurate for slivers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.core.threads import map_in_pieces
from torchpt.math.vectors import cross, dot, normalize

__all__ = ["smooth_normals"]


def _length(a: Tensor) -> Tensor:
    """Return lengths ``(N,)`` of vectors ``(3, N)``, with derivative 0 at 0."""
    # The inner ``where`` keeps the infinite derivative of the root at 0 out of the backward pass.
    square = dot(a, a)
    return torch.where(square > 0, torch.where(square > 0, square, 1.0).sqrt(), 0.0)


def smooth_normals(vertices: Tensor, faces: Tensor, least: float = 0.0) -> Tensor:
    """Return unit normals ``(3, V)`` for vertices ``(3, V)`` and faces ``(F, 3)``; zero where no face has area.

    Also zero where opposite faces cancel: where the weighted sum of normals is no longer than ``least``.
    """
    corner = [vertices.index_select(1, faces[:, k]) for k in range(3)]
    normal = normalize(cross(corner[1] - corner[0], corner[2] - corner[0]))
    total = torch.zeros_like(vertices)
    for k in range(3):
        a = normalize(corner[(k + 1) % 3] - corner[k])
        b = normalize(corner[(k + 2) % 3] - corner[k])
        angle = 2.0 * map_in_pieces(torch.atan2, _length(a - b), _length(a + b))
        total = total.index_add(1, faces[:, k], normal * angle)
    return normalize(total if least == 0.0 else torch.where(_length(total) > least, total, 0.0))
