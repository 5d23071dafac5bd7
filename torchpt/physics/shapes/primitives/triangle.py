"""Triangles: of meshes, with normals and texture coordinates at their corners."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.vectors import cross, dot, normalize
from torchpt.physics.shapes.normals import smooth_normals
from torchpt.physics.shapes.primitive import Corners, Primitive, Triple
from torchpt.physics.shapes.primitives._affine import corner_tangents, unit_uvs

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = ["Triangle"]


class Triangle(Primitive):
    """A triangle of a mesh."""

    name = "triangle"

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """See :meth:`Primitive.corners`."""
        linear, move = pose.split((3, 1), 1)
        assert part.faces is not None
        points = linear @ own["vertices"].T.double() + move
        faces = torch.from_numpy(part.faces).to(points.device)
        if bool(torch.linalg.det(linear.detach()) < 0):
            faces = faces[:, [0, 2, 1]]  # the outside of a mirrored mesh stays outside
        points = points.to(dtype)
        p0, p1, p2 = (points.index_select(1, faces[:, k]) for k in range(3))
        if not part.smooth:
            return Corners(p0=p0, p1=p1, p2=p2, faces=faces, uvs=own.get("uvs"), colors=own.get("colors"))
        if part.normals is None:
            normals = smooth_normals(points, faces)
        else:
            given = own.get("normals", torch.from_numpy(part.normals)).to(linear)
            normals = normalize(torch.linalg.inv(linear).T @ given.T).to(dtype)
        n0, n1, n2 = (normals.index_select(1, faces[:, k]) for k in range(3))
        if not bool((dot(normals, normals) > 0).all()):  # a corner without a normal gets that of its face
            flat = normalize(cross(p1 - p0, p2 - p0))
            n0, n1, n2 = (torch.where(dot(n, n) > 0, n, flat) for n in (n0, n1, n2))
        own_normals = n0, n1, n2
        return Corners(
            p0=p0, p1=p1, p2=p2, normals=own_normals, faces=faces, uvs=own.get("uvs"), colors=own.get("colors")
        )

    @classmethod
    def uvs(cls, part: Part, corners: Corners) -> Triple:
        """See :meth:`Primitive.uvs`; the mesh's texture coordinates, else the triangle's own ``u, v``."""
        if part.uvs is None:
            return unit_uvs(corners)
        assert corners.faces is not None
        given = torch.from_numpy(part.uvs) if corners.uvs is None else corners.uvs
        uv = given.to(corners.p0).T
        first, second, third = (uv.index_select(1, corners.faces[:, k]) for k in range(3))
        return first, second, third

    @classmethod
    def tangent_columns(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """See :meth:`Primitive.tangent_columns`."""
        return (
            super().tangent_columns(part, corners, uvs, linear) if part.uvs is None else corner_tangents(corners, uvs)
        )
