"""Rectangles and, under affine maps, parallelograms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.physics.shapes.primitive import Corners, Primitive, Triple
from torchpt.physics.shapes.primitives._affine import axes_of_all, corner_tangents, unit_uvs

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = ["Rectangle"]


class Rectangle(Primitive):
    """A parallelogram; texture coordinates cover [0, 1]^2."""

    name = "rectangle"

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :meth:`Primitive.corners`; the shape is [-1, 1]^2 as in Mitsuba, ``p0`` its lower corner."""
        return cls.corners_of_many(pose[None], dtype)[0]

    @classmethod
    def corners_of_many(cls, poses: Tensor, dtype: torch.dtype) -> list[Corners]:
        """See :meth:`Primitive.corners_of_many`."""
        move, x, y, mirrored = axes_of_all(poses)
        x, y = 2.0 * x, 2.0 * y
        p0 = move - 0.5 * (x + y)
        # For each corner its columns, one a part.
        c0, c1, c2 = (corner.to(dtype).split(1, 1) for corner in (p0, p0 + x, p0 + y))
        return [
            Corners(p0=own0, p1=own1, p2=own2, mirrored=flag)
            for own0, own1, own2, flag in zip(c0, c1, c2, mirrored, strict=True)
        ]

    @classmethod
    def uvs(cls, part: Part, corners: Corners) -> Triple:
        """See :meth:`Primitive.uvs`."""
        return unit_uvs(corners)

    @classmethod
    def tangent_columns(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Primitive.tangent_columns`."""
        return corner_tangents(corners, uvs)
