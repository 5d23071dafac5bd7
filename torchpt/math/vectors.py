"""Component-first vectors ``(3, N)``: written out per component, which rounds alike at every lane position."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["cross", "dot", "luminance", "normalize", "take"]


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product over the first axis: ``(3, N), (3, N) -> (N,)``."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over the first axis: ``(3, N), (3, N) -> (3, N)``."""
    return torch.stack((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


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


def luminance(rgb: Tensor) -> Tensor:
    """Rec. 709 luminance of linear RGB ``(3, ...) -> (...)``."""
    return 0.212671 * rgb[0] + 0.715160 * rgb[1] + 0.072169 * rgb[2]


def take(table: Tensor, index: Tensor) -> Tensor:
    """Columns of a table: ``(C, M), (N,) -> (C, N)`` or ``(M,), (N,) -> (N,)``. Several times faster than ``[:, index]``."""
    return torch.index_select(table, table.dim() - 1, index)
