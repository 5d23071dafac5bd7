"""Vectors ``(3, N)``, orthonormal frames, angles; look-ups of lanes in tables and records."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from torchpt.core.tree import map_leaves
from torchpt.math.gathers import gather_recorder

__all__ = [
    "SERIES",
    "Frame",
    "affine",
    "azimuth",
    "concatenate_lanes",
    "cross",
    "dot",
    "inverse_square",
    "lanes_of",
    "largest",
    "luminance",
    "normalize",
    "rows",
    "safe_reciprocal",
    "side_by_side",
    "take",
]


# ---- Component-first vectors ``(3, N)``: written out per component, which rounds alike at every lane position
#
# ``addcmul`` is one pass over memory where a product and a sum are two, and it too rounds alike everywhere (tested).


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Compute the dot product over the first axis: ``(3, N), (3, N) -> (N,)``."""
    return torch.addcmul(torch.addcmul(a[0] * b[0], a[1], b[1]), a[2], b[2])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Compute the cross product over the first axis: ``(3, N), (3, N) -> (3, N)``."""
    return torch.stack(
        (
            torch.addcmul(a[1] * b[2], a[2], b[1], value=-1),
            torch.addcmul(a[2] * b[0], a[0], b[2], value=-1),
            torch.addcmul(a[0] * b[1], a[1], b[0], value=-1),
        )
    )


def normalize(a: Tensor) -> Tensor:
    """Normalize vectors ``(3, N)``; a zero vector stays zero and has gradient zero.

    Vectors are scaled by their largest component first, so that squares of 1e-30 and 1e30 stay in the range of float32.
    """
    scale = a.detach().abs().amax(0)
    scale = torch.where(scale > 0, scale, 1.0)
    b = a / scale
    square = dot(b, b)
    nonzero = square > 0
    return torch.where(nonzero, b / torch.where(nonzero, square, 1.0).sqrt(), 0.0)


def affine(p: Tensor, a: Tensor, u: Tensor, b: Tensor, v: Tensor) -> Tensor:
    """Compute ``p + a u + b v`` for vectors ``(3, N)`` and scalars ``(N,)``."""
    return torch.addcmul(torch.addcmul(p, a, u), b, v)


def largest(a: Tensor) -> Tensor:
    """Return the largest component: ``(3, N) -> (N,)``."""
    return torch.maximum(torch.maximum(a[0], a[1]), a[2])


def safe_reciprocal(a: Tensor) -> Tensor:
    """Compute ``1 / a`` for ``a >= 0``; finite (and huge) at 0, where the caller multiplies by 0."""
    return a.clamp_min(torch.finfo(a.dtype).tiny).reciprocal()


def inverse_square(square: Tensor) -> Tensor:
    """Compute ``1 / r^2`` of squared distances ``(N,)``; finite at 0, and so is its derivative, in which r^-4 is."""
    return square.clamp_min(torch.finfo(square.dtype).tiny ** 0.5).reciprocal()


def luminance(rgb: Tensor) -> Tensor:
    """Compute the luminance of linear RGB ``(3, ...) -> (...)``: CIE Y of Rec. 709 primaries, as in pbrt and Mitsuba."""
    return 0.212671 * rgb[0] + 0.715160 * rgb[1] + 0.072169 * rgb[2]


#: Lanes from which on ``torch.gather`` is faster; the lane compiler traces fewer.
_MANY = 512


def take(table: Tensor, index: Tensor | None) -> Tensor:
    """Return columns of a table: ``(C, M), (N,) -> (C, N)`` or ``(M,), (N,) -> (N,)``; ``index`` None: all of them.

    Several times faster than ``table[:, index]``.
    """
    if index is None:
        return table
    if table.requires_grad and (gathers := gather_recorder()) is not None and torch.is_grad_enabled():
        taken = gathers.take(table, index)
        if taken is not None:
            return taken
    if table.dtype is not torch.float32 and table.dim() == 2 and index.shape[0] >= _MANY and table.is_cpu:
        # torch's index_select is vectorized for float32 alone.
        return torch.gather(table, 1, index.long().expand(len(table), -1))
    return torch.index_select(table, table.dim() - 1, index)


#: Fewer columns are laid out by kernels themselves in no time.
_COLUMNS = 4096


def side_by_side(table: Tensor) -> Tensor:
    """Return a table ``(C, M)`` of which each column lies in one place of memory: kernels read it so, without a copy."""
    return table if table.shape[1] < _COLUMNS else table.T.contiguous().T


def lanes_of(mask: Tensor) -> Tensor | None:
    """Return the lanes ``(n,)`` where a mask is True; None, which :func:`take` knows as all of them, where it is everywhere."""
    index = mask.nonzero().squeeze(1)
    return None if index.shape[0] == mask.shape[0] else index


T = TypeVar("T")


def rows(record: T, index: Tensor | None) -> T:
    """Return the lanes ``index`` of all tensors in a record (None: all); other fields stay."""
    return record if index is None else map_leaves(lambda table: take(table, index), record)


def concatenate_lanes(records: list[T]) -> T:
    """Concatenate records along the lanes' axis."""
    return records[0] if len(records) == 1 else map_leaves(lambda *parts: torch.cat(parts, -1), *records)


# ---- Orthonormal frames about a normal: ``+z`` is the normal
#
# Duff, Burgess, Christensen, Hery, Kensler, Liani, Villemin: *Building an Orthonormal Basis, Revisited*, JCGT 6(1), 2017.


@dataclass(frozen=True)
class Frame:
    """Tangent, bitangent and normal, each ``(3, N)``."""

    s: Tensor
    t: Tensor
    n: Tensor

    @staticmethod
    def about(n: Tensor) -> Frame:
        """Return a frame about unit normals ``(3, N)``; continuous except at ``n.z = 0``, and never degenerate."""
        sign = torch.copysign(torch.ones_like(n[2]), n[2])
        a = -1.0 / (sign + n[2])
        b = n[0] * n[1] * a
        s = torch.stack((1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]))
        t = torch.stack((b, sign + n[1] * n[1] * a, -n[1]))
        return Frame(s, t, n)

    @staticmethod
    def along(n: Tensor, tangent: Tensor) -> Frame:
        """Return the frame about unit normals ``n (3, N)`` with ``s`` nearest to ``tangent (3, N)``; any frame if parallel."""
        s = torch.addcmul(tangent, n, dot(n, tangent), value=-1)
        square, whole = dot(s, s), dot(tangent, tangent)
        usable = square > 1e-12 * whole  # up to a sine of 1e-6 the two count as parallel
        s = torch.where(usable, s / torch.where(usable, square, 1.0).sqrt(), Frame.about(n).s)
        return Frame(s, cross(n, s), n)

    def to_local(self, w: Tensor) -> Tensor:
        """Transform vectors ``(3, N)`` from the world to the frame."""
        return torch.stack((dot(self.s, w), dot(self.t, w), dot(self.n, w)))

    def to_world(self, w: Tensor) -> Tensor:
        """Transform vectors ``(3, N)`` from the frame to the world."""
        return affine(self.s * w[0], self.t, w[1], self.n, w[2])


# ---- An angle that rounds alike at every lane position, which ``torch.atan2`` does not


#: ``atan(x) / x`` in powers of ``x^2`` for ``|x| <= tan(pi / 8)``: Chebyshev interpolation, error below 3e-13.
SERIES = (
    0.9999999999992449,
    -0.33333333276920757,
    0.19999993053407192,
    -0.1428538654655432,
    0.11103456759179119,
    -0.08992551401945466,
    0.06974190432707487,
    -0.03765497158862104,
)
_TURN = 2.0 * math.pi


def azimuth(x: Tensor, y: Tensor) -> Tensor:
    """Compute angles ``(N,)`` in ``[0, 2 pi)`` from +x to ``(x, y)``, counter-clockwise; 0 at the origin, gradients finite."""
    # Absolute values by a sign that is never 0: torch.abs has gradient 0 at 0.
    sign_x, sign_y = (torch.copysign(torch.ones_like(a), a).detach() for a in (x, y))
    a, b = x * sign_x, y * sign_y
    steep = b > a
    low, high = torch.where(steep, a, b), torch.where(steep, b, a)
    # Scaled by a constant, so that the sum below neither overflows nor underflows.
    scale = high.detach()
    scale = torch.where(scale > 0, scale, 1.0)
    low, high = low / scale, torch.where(high > 0, high / scale, 1.0)
    # atan(r) = pi / 4 + atan((r - 1) / (r + 1)) maps the upper half of the octant to the lower half.
    upper = low > (math.sqrt(2.0) - 1.0) * high
    ratio = torch.where(upper, low - high, low) / torch.where(upper, low + high, high)
    square = ratio * ratio
    series = torch.full_like(square, SERIES[-1])
    for coefficient in reversed(SERIES[:-1]):
        series = series * square + coefficient
    angle = ratio * series + upper.to(x.dtype) * (0.25 * math.pi)
    angle = torch.where(steep, 0.5 * math.pi - angle, angle)
    angle = torch.where(x < 0, math.pi - angle, angle)
    angle = torch.where(y < 0, _TURN - angle, angle)
    return torch.where(angle >= _TURN, angle - _TURN, angle)
