"""What a primitive is: where it lies when a scene is assembled, and what lanes make of a hit on it."""

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
    """The primitives of one part: ``(3, P)`` each, see :class:`~torchpt.physics.shapes.geometry.Geometry`.

    Attributes:
        normals: at the corners, or None.
        faces: ``(P, 3)`` vertices at the corners; of meshes only.
        mirrored: whether a flat shape's two axes changed places.
        frame: ``(12, 1)`` float64 ``p0 e1 e2 e3`` of a quadric.
        uvs: ``(V, 2)`` at the vertices, where they are a parameter of the scene; else the part has them.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    normals: Triple | None = None
    faces: Tensor | None = None
    mirrored: bool = False
    frame: Tensor | None = None
    uvs: Tensor | None = None


@dataclass(frozen=True)
class LanePrimitives:
    """Where primitives lie: what interactions need of them before a point is chosen."""

    prim: Tensor  # (N,) below P
    p0: Tensor  # (3, N)
    e1: Tensor  # (3, N)
    e2: Tensor  # (3, N)
    copies: Instances | None = None  # columns (., N) where the scene has copies
    copied: Tensor | None = None  # (N,) bool: which are copies
    reach: Tensor | None = None  # (3, N) coordinate magnitudes that enter a point's sum, where the scene has copies

    def moved(self, w: Tensor) -> Tensor:
        """Vectors ``(3, N)`` of a mesh as those of its copy."""
        assert self.copies is not None
        return _linear(self.copies, w)

    def turned(self, n: Tensor) -> Tensor:
        """Unit normals ``(3, N)`` of a mesh as those of its copy."""
        assert self.copies is not None and self.copied is not None
        turned = affine(self.copies.nx * n[0], self.copies.ny, n[1], self.copies.nz, n[2])
        return torch.where(self.copied, normalize(turned), n)


def _linear(copies: Instances, w: Tensor) -> Tensor:
    return affine(copies.x * w[0], copies.y, w[1], copies.z, w[2])


def lane_primitives(world: World, prim: Tensor) -> LanePrimitives:
    """Places of primitives by ids as the search gives them, none of them a miss."""
    geometry = world.geometry
    if geometry.copies is None:
        return LanePrimitives(prim, take(geometry.p0, prim), take(geometry.e1, prim), take(geometry.e2, prim))
    column = geometry.copy(prim)
    table = rows(geometry.copies, column)
    prim = prim - table.start + table.first
    p0, e1, e2 = take(geometry.p0, prim), take(geometry.e1, prim), take(geometry.e2, prim)
    size = (p0.abs() + e1.abs() + e2.abs()).detach()
    reach = affine(table.x.abs() * size[0], table.y.abs(), size[1], table.z.abs(), size[2]) + table.move.abs()
    p0, e1, e2 = _linear(table, p0) + table.move, _linear(table, e1), _linear(table, e2)
    return LanePrimitives(prim, p0, e1, e2, table, column > 0, reach.detach())


@dataclass(frozen=True)
class Rays:
    """Rays and what they met.

    Attributes:
        o: origins ``(3, N)``.
        d: directions ``(3, N)``.
        hit: from the search.
        follow_shape: whether points follow ``o``, ``d`` and the geometry.
    """

    o: Tensor
    d: Tensor
    hit: Hit
    follow_shape: bool = False


@dataclass(frozen=True)
class HitPoints:
    """Points of surfaces that are not flat; lanes of other kinds hold anything.

    Attributes:
        p: ``(3, N)``.
        ng: unit geometric normals ``(3, N)``.
        bound: ``(N,)`` in place of ``LaneGeometry.bound``; None: that.
        own: points ``(3, N)`` in the surface's own space, where it has one.
    """

    p: Tensor
    ng: Tensor
    bound: Tensor | None = None
    own: Tensor | None = None


@dataclass(frozen=True)
class FixedPoints:
    """Points that stay where they are on their surfaces."""

    p: Tensor  # (3, N)
    area: Tensor  # (3, N) along the normal, as long as what area becomes in the world


class Primitive:
    """A kind of primitive; as it stands a flat one, whose point is ``p0 + u e1 + v e2``.

    The search meets it by kernels of its own (:mod:`torchpt.search`).

    Attributes:
        name: one of :data:`torchpt.physics.shapes.geometry.KINDS`.
        flat: whether its point is that of its plane; those that are come first.
        has_own_uv: whether its texture coordinates are not affine: then :meth:`tangents` and :meth:`uv` say them.
        angles: whether it stays what it is under maps that keep angles alone.
    """

    name: ClassVar[str] = ""
    flat: ClassVar[bool] = True
    has_own_uv: ClassVar[bool] = False
    angles: ClassVar[bool] = False

    # -- when a scene is assembled

    @classmethod
    def corners(cls, part: Part, pose: Tensor, dtype: torch.dtype, own: Mapping[str, Tensor]) -> Corners:
        """Where the primitives of a part lie.

        Args:
            part: whose.
            pose: ``(3, 4)`` float64 into the lanes' coordinates.
            dtype: of the lanes.
            own: arrays of the part that are parameters of the scene: ``vertices (V, 3)`` in its own space, of meshes always;
                ``normals (V, 3)`` and ``uvs (V, 2)`` where gradients of them are wanted.
        """
        raise NotImplementedError

    @classmethod
    def corners_of_many(cls, poses: Tensor, dtype: torch.dtype) -> list[Corners] | None:
        """The corners of parts that are no more than a pose each, ``(N, 3, 4)``, at once; None: one by one."""
        return None

    @classmethod
    def uvs(cls, part: Part, corners: Corners) -> Triple:
        """Texture coordinates ``(2, P)`` at the corners; zero where :meth:`uv` says them."""
        nothing = torch.zeros_like(corners.p0[:2])
        return nothing, nothing, nothing

    @classmethod
    def moves(cls, part: Part, corners: Corners, uvs: Triple, linear: Tensor) -> tuple[Tensor, Tensor]:
        """What :meth:`tangents` needs of ``LaneGeometry.tangents`` and ``bitangents``: ``(3, P)`` each.

        Args:
            part: whose.
            corners: of it.
            uvs: of it.
            linear: ``(3, 3)`` of its pose.
        """
        return torch.zeros_like(corners.p0), torch.zeros_like(corners.p0)

    # -- on lanes; what is given back where a lane is of another kind means nothing

    @classmethod
    def hit_points(cls, world: World, place: LanePrimitives, rays: Rays, mine: Tensor) -> HitPoints:
        """Points of hits; not of flat kinds. ``mine (N,)``: which lanes are of this kind."""
        raise NotImplementedError

    @classmethod
    def fixed_points(cls, world: World, place: LanePrimitives, rays: Rays, mine: Tensor) -> FixedPoints:
        """Points that stay on their surface where rays met it, as these and the surface move; not of flat kinds."""
        raise NotImplementedError

    @classmethod
    def tangents(
        cls, world: World, place: LanePrimitives, at: Interaction, mine: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """How points move with their texture coordinates, ``(3, N)`` each, the second where ``at`` has one; of charted kinds.

        Args:
            world: the scene's tensors.
            place: where the primitives lie.
            at: the points, with the primitives' columns of ``LaneGeometry.tangents`` and ``bitangents``.
            mine: which lanes are of this kind.
        """
        raise NotImplementedError

    @classmethod
    def uv(cls, world: World, at: Interaction) -> Tensor | None:
        """Texture coordinates ``(2, N)``, of charted kinds; None where none of the points is of this kind."""
        raise NotImplementedError


#: The kinds of primitives.
PRIMITIVES: Kinds[Primitive] = Kinds("torchpt.physics.shapes.primitives", KINDS)
