"""Planar emitters (triangle, rectangle, disk): points and their density by area. They shine from the side of their normal."""

from __future__ import annotations

from torch import Tensor

from torchpt.math.vectors import affine, dot, safe_reciprocal

__all__ = ["inverse_pdf", "point"]


def point(p0: Tensor, e1: Tensor, e2: Tensor, uv: Tensor) -> Tensor:
    """The point ``(3, N)`` at ``(u, v)`` of affine primitives."""
    return affine(p0, e1, uv[0], e2, uv[1])


def inverse_pdf(normal: Tensor, area: Tensor, wi: Tensor, square: Tensor) -> Tensor:
    """``1 / pdf`` in solid angle, ``area cos / r^2``; 0 behind the emitter.

    Args:
        normal: of the emitting side ``(3, N)``.
        area: ``(N,)``.
        wi: unit direction toward the light ``(3, N)``.
        square: squared distance ``(N,)``.
    """
    cosine = (-dot(wi, normal)).clamp_min(0.0)
    return area * cosine * safe_reciprocal(square)
