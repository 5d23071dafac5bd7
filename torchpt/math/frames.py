"""Orthonormal frames about a normal: ``+z`` is the normal.

Duff, Burgess, Christensen, Hery, Kensler, Liani, Villemin: *Building an Orthonormal Basis, Revisited*, JCGT 6(1), 2017.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import affine, cross, dot

__all__ = ["Frame"]


@dataclass(frozen=True)
class Frame:
    """Tangent, bitangent and normal, each ``(3, N)``."""

    s: Tensor
    t: Tensor
    n: Tensor

    @staticmethod
    def about(n: Tensor) -> Frame:
        """The frame about unit normals ``(3, N)``; continuous but for ``n.z = 0``, and never degenerate."""
        sign = torch.copysign(torch.ones_like(n[2]), n[2])
        a = -1.0 / (sign + n[2])
        b = n[0] * n[1] * a
        s = torch.stack((1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]))
        t = torch.stack((b, sign + n[1] * n[1] * a, -n[1]))
        return Frame(s, t, n)

    @staticmethod
    def along(n: Tensor, tangent: Tensor) -> Frame:
        """The frame about unit normals ``n (3, N)`` whose ``s`` is next to ``tangent (3, N)``; any where that is along n."""
        s = torch.addcmul(tangent, n, dot(n, tangent), value=-1)
        square, whole = dot(s, s), dot(tangent, tangent)
        usable = square > 1e-12 * whole
        s = torch.where(usable, s / torch.where(usable, square, 1.0).sqrt(), Frame.about(n).s)
        return Frame(s, cross(n, s), n)

    def to_local(self, w: Tensor) -> Tensor:
        """World ``(3, N)`` to local."""
        return torch.stack((dot(self.s, w), dot(self.t, w), dot(self.n, w)))

    def to_world(self, w: Tensor) -> Tensor:
        """Local ``(3, N)`` to world."""
        return affine(self.s * w[0], self.t, w[1], self.n, w[2])
