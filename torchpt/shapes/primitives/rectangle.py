"""Rectangles, which transforms make parallelograms of."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.shapes.primitive import Corners, Primitive, Triple
from torchpt.shapes.primitives._affine import axes_of, corner_moves, unit_uvs

if TYPE_CHECKING:
    from torchpt.scene.parts import Part

__all__ = ["Rectangle"]


class Rectangle(Primitive):
    """A parallelogram; texture coordinates run over [0, 1]^2."""

    name = "rectangle"

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :class:`Primitive`: Mitsuba's unit shape [-1, 1]^2 from its lower corner."""
        move, x, y, mirrored = axes_of(pose)
        x, y = 2.0 * x, 2.0 * y
        p0 = move - 0.5 * (x + y)
        return Corners(p0.to(dtype), (p0 + x).to(dtype), (p0 + y).to(dtype), mirrored=mirrored)

    @classmethod
    def uvs(cls, part: Part, corners: Corners) -> Triple:
        """See :class:`Primitive`."""
        return unit_uvs(corners)

    @classmethod
    def moves(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """See :class:`Primitive`."""
        return corner_moves(corners, uvs)
