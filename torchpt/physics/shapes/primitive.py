"""The base class of primitives: their geometry when a world is built, and surface points of hits on them.

A *part* is a set of primitives of one kind that share a shape and a material. Flat kinds (triangle, rectangle, disk) share one
affine form, which this class has; spheres and quadrics override the methods on lanes. These methods are called with the lanes
of all kinds together and a mask ``is_kind (N,)`` of those that count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import affine, normalize, rows, take
from torchpt.physics.shapes.geometry import KINDS, Hit, Instances, Interaction
from torchpt.physics.world import World
from torchpt.spec import Kinds

if TYPE_CHECKING:
    from torchpt.physics.parts import Part

__all__ = [
    "PRIMITIVES",
    "Corners",
    "FixedPoints",
    "HitPoints",
    "LanePrimitives",
    "Primitive",
    "Rays",
    "lane_primitives",
]

Triple = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Corners:
    """Geometry of the primitives of one part: ``(3, P)`` each, see :class:`~torchpt.physics.shapes.geometry.Geometry`.

    Flat kinds have corners in ``p0 p1 p2``; a quadric has ``p0 e1 e2`` there, a sphere its centre and its radius.

    Attributes:
        normals: normals at the corners, or None.
        faces: ``(P, 3)`` vertex indices of the corners; meshes only.
        mirrored: whether the two axes of a flat shape were swapped.
        frame: ``(12, 1)`` float64 ``p0 e1 e2 e3`` of a quadric.
        uvs: ``(V, 2)`` texture coordinates at the vertices if they are a parameter of the scene; None: those of the part.
        colors: ``(V, 3)`` linear colours at the vertices; None: there are none.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    normals: Triple | None = None
    faces: Tensor | None = None
    mirrored: bool = False
    frame: Tensor | None = None
    uvs: Tensor | None = None
    colors: Tensor | None = None


@dataclass(frozen=True)
class LanePrimitives:
    """Geometry of the primitives of N lanes, with their instances."""

    prim: Tensor  # (N,) index below P: of an instance the triangle of its mesh
    p0: Tensor  # (3, N) in the world: of an instance already transformed, as e1 and e2
    e1: Tensor  # (3, N)
    e2: Tensor  # (3, N)
    copies: Instances | None = None  # columns (., N); None without instances
    is_instanced: Tensor | None = None  # (N,) bool: primitives of instances
    coordinate_bound: Tensor | None = (
        None  # (3, N) sums of coordinate magnitudes, for rounding bounds; None without instances
    )

    def vectors_to_instance(self, w: Tensor) -> Tensor:
        """Transform vectors ``(3, N)`` from the mesh to its instance."""
        assert self.copies is not None
        return _linear(self.copies, w)

    def normals_to_instance(self, n: Tensor) -> Tensor:
        """Transform unit normals ``(3, N)`` from the mesh to its instance."""
        assert self.copies is not None and self.is_instanced is not None
        transformed = affine(self.copies.nx * n[0], self.copies.ny, n[1], self.copies.nz, n[2])
        return torch.where(self.is_instanced, normalize(transformed), n)


def _linear(copies: Instances, w: Tensor) -> Tensor:
    """Apply the linear maps of instances to vectors ``w (3, N)``."""
    return affine(copies.x * w[0], copies.y, w[1], copies.z, w[2])


def lane_primitives(world: World, prim: Tensor) -> LanePrimitives:
    """Return the geometry of primitives by their ids in the search, none of them a miss."""
    geometry = world.geometry
    if geometry.copies is None:
        return LanePrimitives(
            prim=prim, p0=take(geometry.p0, prim), e1=take(geometry.e1, prim), e2=take(geometry.e2, prim)
        )
    column = geometry.instance_column(prim)
    table = rows(geometry.copies, column)
    prim = prim - table.start + table.first  # from the instance's ids to those of the mesh
    p0, e1, e2 = take(geometry.p0, prim), take(geometry.e1, prim), take(geometry.e2, prim)
    size = (p0.abs() + e1.abs() + e2.abs()).detach()
    coordinate_bound = (
        affine(table.x.abs() * size[0], table.y.abs(), size[1], table.z.abs(), size[2]) + table.move.abs()
    )
    p0, e1, e2 = _linear(table, p0) + table.move, _linear(table, e1), _linear(table, e2)
    return LanePrimitives(
        prim=prim,
        p0=p0,
        e1=e1,
        e2=e2,
        copies=table,
        is_instanced=column > 0,
        coordinate_bound=coordinate_bound.detach(),
    )


@dataclass(frozen=True)
class Rays:
    """Rays and their hits.

    Attributes:
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        hit: hits of the search.
        follow_ray: whether points follow ``o``, ``d`` and the geometry.
    """

    o: Tensor
    d: Tensor
    hit: Hit
    follow_ray: bool = False


@dataclass(frozen=True)
class HitPoints:
    """Hit points on primitives of one kind that is not flat; values in lanes of other kinds are arbitrary.

    Attributes:
        p: ``(3, N)``.
        ng: unit geometric normals ``(3, N)``.
        bound: rounding bounds ``(N,)``; None: ``LaneGeometry.bound``.
        own: points ``(3, N)`` in object space, for quadrics.
    """

    p: Tensor
    ng: Tensor
    bound: Tensor | None = None
    own: Tensor | None = None


@dataclass(frozen=True)
class FixedPoints:
    """Hit points that stay fixed on their surfaces under differentiation."""

    p: Tensor  # (3, N)
    area: Tensor  # (3, N) along the normal; its length is the ratio of area in the world to area in the parametrization


class Primitive:
    """A kind of primitive. This class implements flat ones, with points ``p0 + u e1 + v e2``.

    The search has kernels of its own to intersect primitives (:mod:`torchpt.search`).

    Attributes:
        name: one of :data:`torchpt.physics.shapes.geometry.KINDS`.
        flat: whether points lie in the plane ``p0 + u e1 + v e2``. Flat kinds come first in the order of kinds.
        has_own_uv: whether :meth:`uv` and :meth:`tangents` of the kind compute texture coordinates, which are not affine in
            ``u, v``.
        needs_similarity: whether only similarity transforms keep the kind: a sheared sphere is none.
    """

    name: ClassVar[str] = ""
    flat: ClassVar[bool] = True
    has_own_uv: ClassVar[bool] = False
    needs_similarity: ClassVar[bool] = False

    # -- when a world is built

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """Return the geometry of the primitives of a part.

        Args:
            part: the part.
            pose: ``(3, 4)`` float64, to world coordinates.
            dtype: dtype of the world.
            own: arrays of the part that are parameters of the scene: ``vertices (V, 3)`` in object space for all meshes;
                ``normals (V, 3)`` and ``uvs (V, 2)`` if they are differentiated, and ``colors (V, 3)``.
        """
        raise NotImplementedError

    @classmethod
    def corners_of_many(cls, poses: Tensor, dtype: torch.dtype) -> list[Corners] | None:
        """Return :meth:`corners` of N parts given by their poses ``(N, 3, 4)`` alone; None: not implemented."""
        return None

    @classmethod
    def uvs(cls, part: Part, corners: Corners) -> Triple:
        """Return texture coordinates ``(2, P)`` at the corners; zero for kinds with :attr:`has_own_uv`."""
        nothing = torch.zeros_like(corners.p0[:2])
        return nothing, nothing, nothing

    @classmethod
    def tangent_columns(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """Return the columns of ``LaneGeometry.tangents`` and ``bitangents`` of a part: ``(3, P)`` each.

        Args:
            part: the part.
            corners: the part's :meth:`corners`.
            uvs: the part's :meth:`uvs`.
            linear: linear part ``(3, 3)`` of the pose.
        """
        return torch.zeros_like(corners.p0), torch.zeros_like(corners.p0)

    # -- on lanes; results in lanes of other kinds are arbitrary

    @classmethod
    def hit_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> HitPoints:
        """Return the hit points, for kinds that are not flat; ``is_kind (N,)`` masks lanes of this kind."""
        raise NotImplementedError

    @classmethod
    def fixed_points(cls, world: World, primitives: LanePrimitives, rays: Rays, is_kind: Tensor) -> FixedPoints:
        """Return the hit points fixed on their surfaces under differentiation, for kinds that are not flat."""
        raise NotImplementedError

    @classmethod
    def tangents(
        cls, world: World, primitives: LanePrimitives, at: Interaction, is_kind: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return derivatives of points by texture coordinates, ``(3, N)`` each, the second if ``at`` has a bitangent.

        Called for kinds with :attr:`has_own_uv`.

        Args:
            world: the scene's tensors.
            primitives: geometry of the primitives.
            at: the points, with columns of ``LaneGeometry.tangents`` and ``bitangents``.
            is_kind: mask ``(N,)`` of lanes of this kind.
        """
        raise NotImplementedError

    @classmethod
    def uv(cls, world: World, at: Interaction) -> Tensor | None:
        """Return texture coordinates ``(2, N)``, for kinds with :attr:`has_own_uv`; None if no point is of this kind."""
        raise NotImplementedError


#: The kinds of primitives.
PRIMITIVES: Kinds[Primitive] = Kinds("torchpt.physics.shapes.primitives", KINDS)
