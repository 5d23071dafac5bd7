"""Emitters that are quadrics under affine maps, sampled uniformly by area in the surface's own space.

Under a map M with cofactor matrix C the area element at own normal n grows by ``|C n| = |det M| / |M^T N|``, N the world's
unit normal: what was sampled and what was hit by chance agree on the density from N alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.vectors import affine, dot
from torchpt.records import Quadrics
from torchpt.shapes import quadrics

__all__ = ["own_point", "point", "world_area"]


def point(p0: Tensor, e1: Tensor, e2: Tensor, table: Quadrics, u: Tensor) -> tuple[Tensor, Tensor]:
    """Points ``(3, N)`` on the emitters and the emitting side's unit normals there."""
    own = own_point(table, u)
    return affine(p0 + e1 * own[0], e2, own[1], table.e3, own[2]), quadrics.outward(table, own)


def own_point(table: Quadrics, u: Tensor) -> Tensor:
    """The points ``(3, N)`` of :func:`point` in the surface's own space."""
    return quadrics.sample(table, u)


def world_area(area: Tensor, e1: Tensor, e2: Tensor, e3: Tensor, normal: Tensor) -> Tensor:
    """One over the density by area of :func:`point` at ``normal (3, N)``.

    Args:
        area: area in the own space times ``|det|`` ``(N,)``.
        e1: ``(3, N)``.
        e2: ``(3, N)``.
        e3: ``(3, N)``.
        normal: unit, of the world ``(3, N)``.
    """
    a, b, c = dot(e1, normal), dot(e2, normal), dot(e3, normal)
    square = a * a + b * b + c * c
    return area / torch.where(square > 0, square, 1.0).sqrt()
