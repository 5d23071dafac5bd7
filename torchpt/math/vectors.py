"""Component-first vectors ``(3, N)``: written out per component, which rounds alike at every lane position.

``addcmul`` is one pass over memory where a product and a sum are two, and it too rounds alike everywhere (tested).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.math.gathers import gatherer

__all__ = ["affine", "cross", "dot", "largest", "luminance", "normalize", "safe_reciprocal", "take"]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product over the first axis: ``(3, N), (3, N) -> (N,)``."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over the first axis: ``(3, N), (3, N) -> (3, N)``."""
    return torch.stack(
        (
            torch.addcmul(a[1] * b[2], a[2], b[1], value=-1),
            torch.addcmul(a[2] * b[0], a[0], b[2], value=-1),
            torch.addcmul(a[0] * b[1], a[1], b[0], value=-1),
        )
    )


def normalize(a: Tensor) -> Tensor:
    """Unit vectors ``(3, N)``; a zero vector stays zero and passes a zero gradient.

    Scaled by the largest component first, so that neither 1e-30 nor 1e30 leaves the range of float32.
    """
    scale = a.detach().abs().amax(0)
    scale = torch.where(scale > 0, scale, 1.0)
    b = a / scale
    square = dot(b, b)
    nonzero = square > 0
    return torch.where(nonzero, b / torch.where(nonzero, square, 1.0).sqrt(), 0.0)


def affine(p: Tensor, a: Tensor, u: Tensor, b: Tensor, v: Tensor) -> Tensor:
    """``p + a u + b v`` for vectors ``(3, N)`` and scalars ``(N,)``."""
    return torch.addcmul(torch.addcmul(p, a, u), b, v)


def largest(a: Tensor) -> Tensor:
    """The largest component: ``(3, N) -> (N,)``."""
    return torch.maximum(torch.maximum(a[0], a[1]), a[2])


def safe_reciprocal(a: Tensor) -> Tensor:
    """``1 / a`` for ``a >= 0``; finite (and huge) at 0, where the caller's other factor is 0."""
    return a.clamp_min(torch.finfo(a.dtype).tiny).reciprocal()


def luminance(rgb: Tensor) -> Tensor:
    """Luminance of linear RGB ``(3, ...) -> (...)``: Y of CIE XYZ by the primaries of Rec. 709, as in pbrt and Mitsuba."""
    return 0.212671 * rgb[0] + 0.715160 * rgb[1] + 0.072169 * rgb[2]


def take(table: Tensor, index: Tensor | None) -> Tensor:
    """Columns of a table: ``(C, M), (N,) -> (C, N)`` or ``(M,), (N,) -> (N,)``. Several times faster than ``[:, index]``.

    ``index`` None: all of them.
    """
    if index is None:
        return table
    if table.requires_grad and (gathers := gatherer()) is not None and torch.is_grad_enabled():
        taken = gathers.take(table, index)
        if taken is not None:
            return taken
    return torch.index_select(table, table.dim() - 1, index)
