"""Geometry as the search and the lanes hold it, hits, and points on surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.physics.shapes.primitive import Primitive
    from torchpt.physics.shapes.quadrics import Quadric

__all__ = ["KINDS", "Geometry", "Hit", "Instances", "Interaction", "LaneGeometry", "QuadricTable", "Quadrics"]


#: Primitive kinds in the order in which a :class:`Geometry` stores them; each is a file in ``physics/shapes/primitives/``.
KINDS = ("triangle", "rectangle", "disk", "sphere", "quadric")


@dataclass(frozen=True)
class Geometry:
    """The primitives as the search sees them: float32, detached, contiguous, on one device.

    A planar primitive is the affine map ``p = p0 + u (p1 - p0) + v (p2 - p0)``: a triangle holds ``u, v >= 0, u + v <= 1``,
    a rectangle (parallelogram) ``0 <= u, v <= 1``, a disk (ellipse) ``u^2 + v^2 <= 1`` about its centre ``p0``.
    A sphere has its centre in ``p0`` and its radius in ``p1[0]``. A quadric is a surface in its own space under the affine map
    ``p = p0 + x e1 + y e2 + z e3``, kept in float64 beside the others.

    Attributes:
        p0: ``(3, P)``.
        p1: ``(3, P)``; of a quadric its ``e1``.
        p2: ``(3, P)``; of a quadric its ``e2``.
        counts: how many primitives of each of :data:`KINDS`; stored in that order.
        quadrics: None where there are none.
        copies: ``(15, I)`` float64: three rows of the map from a mesh to its copy, the first triangle of that mesh, how many it
            has, and the id of the copy's first primitive; None where there are no instances. A copy's primitives exist by
            their ids alone, which follow those of all others.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    counts: tuple[int, int, int, int, int]
    quadrics: QuadricTable | None = None
    copies: Tensor | None = None

    @property
    def size(self) -> int:
        """Number of primitives P, copies not counted."""
        return sum(self.counts)


@dataclass(frozen=True)
class QuadricTable:
    """The quadrics as the search sees them: numbers alone, whatever their surfaces are called; float64, detached."""

    frame: Tensor  # (12, Q) p0 e1 e2 e3
    form: Tensor  # (7, Q) the surface in its own space, see torchpt.physics.shapes.quadrics.Form
    low: Tensor  # (3, Q) its box in the world
    high: Tensor  # (3, Q)


@dataclass(frozen=True)
class Quadrics:
    """Numbers that lanes gather of a quadric beside ``LaneGeometry.p0, e1, e2``: one column a quadric."""

    kinds: tuple[type[Quadric], ...]  # the surfaces among them; static
    code: Tensor | None  # (Q,) int64 index into `kinds`; None where there is but one
    e3: Tensor  # (3, Q)
    n1: Tensor  # (3, Q) columns of the cofactor matrix of (e1, e2, e3), turned to the front; their common scale is free
    n2: Tensor  # (3, Q)
    n3: Tensor  # (3, Q)
    reach: Tensor  # (3, Q) largest coordinate magnitudes that enter a point's sum, see LaneGeometry.bound


@dataclass(frozen=True)
class Instances:
    """Instances of meshes: column 0 is the identity, that of all that is no copy; column k belongs to copy k - 1.

    What is kept by primitive splits in two: its place on a mesh, looked up by :attr:`Interaction.prim`, and what a copy has of
    its own (material, opacity, object id), by :attr:`Interaction.slot`: rows after the P of the primitives, one a copy.
    """

    start: Tensor  # (I + 1,) int64 id of the copy's first primitive
    first: Tensor  # (I + 1,) int64 first triangle of its mesh
    x: Tensor  # (3, I + 1) columns of the linear map
    y: Tensor  # (3, I + 1)
    z: Tensor  # (3, I + 1)
    move: Tensor  # (3, I + 1)
    nx: Tensor  # (3, I + 1) columns of its cofactor matrix, turned to the front; their scale is free
    ny: Tensor  # (3, I + 1)
    nz: Tensor  # (3, I + 1)


@dataclass(frozen=True)
class LaneGeometry:
    """Places of surfaces, as the lanes gather them: P primitives, and I copies (see :class:`Instances`)."""

    kinds: tuple[type[Primitive], ...]  # those that there are, in the order of KINDS; static
    counts: tuple[int, int, int, int, int]  # as in Geometry; static: lanes read `ends`
    ends: Tensor  # (5,) int64 the id after the last primitive of each kind
    p0: Tensor  # (3, P)
    e1: Tensor  # (3, P)
    e2: Tensor  # (3, P)
    normal: Tensor  # (3, P) unit geometric normal; zero for spheres, without meaning for quadrics
    bound: Tensor  # (P,) sum |n_i| max |p_i| over the primitive: scales the rounding of its plane
    flip: Tensor | None  # (P,) orientation of spheres
    normals: tuple[Tensor, Tensor, Tensor] | None  # (3, P) shading normals at the corners, where any are smooth
    #: (3, P) how p moves with texture coordinate u; zero: any direction will do. Of a sphere the vector whose cross product
    #: with the normal it is. None where no frame needs it.
    tangents: Tensor | None
    bitangents: Tensor | None  # (3, P) the same for v; of a sphere (pi r, 0, 0). None without bump maps
    uvs: tuple[Tensor, Tensor, Tensor] | None  # (2, P) texture coordinates at the corners; None without textures
    axes: tuple[Tensor, Tensor, Tensor] | None  # (3, S) unit x, y, z of the spheres; None without textures or spheres
    mirrored: Tensor | None  # (P,) bool: disks whose u and v are swapped; None where none are, or none matter
    colors: tuple[Tensor, Tensor, Tensor] | None  # (3, P) at the corners, where vertex colours are read
    object_id: Tensor  # (P + I,) int64, order of the shape in the scene
    quadrics: Quadrics | None = None  # None where there are none
    copies: Instances | None = None  # None where there are no instances

    def slot(self, prim: Tensor) -> Tensor:
        """Rows ``(N,)`` of what copies have of their own, for ids of primitives as the search gives them; -1 stays."""
        if self.copies is None:
            return prim
        import torch

        copy = self.copy(prim)
        return torch.where(copy > 0, copy + (self.ends[4] - 1), prim)

    def of(self, kind: type[Primitive], prim: Tensor) -> Tensor:
        """Return which of ``prim (N,)`` are of a kind that the scene has: ``(N,)`` bool."""
        number = KINDS.index(kind.name)
        after = prim >= self.ends[number - 1] if number else prim >= 0
        return after & (prim < self.ends[number]) if any(self.counts[number + 1 :]) else after

    def copy(self, prim: Tensor) -> Tensor:
        """Columns ``(N,)`` of ``copies`` for ids of primitives as the search gives them."""
        import torch

        assert self.copies is not None
        return torch.searchsorted(self.copies.start[1:], prim, right=True)


@dataclass(frozen=True)
class Hit:
    """Hits of rays, as the search found them."""

    t: Tensor  # (N,) in units of |d|
    prim: Tensor  # (N,) int64, -1 for a miss; of a copy beyond P, see Copies
    u: Tensor  # (N,)
    v: Tensor  # (N,)
    chance: Tensor | None = (
        None  # (N,) 1, with the derivative of the chance to get here; None: no derivative, or no chance
    )


@dataclass(frozen=True)
class Interaction:
    """A surface point, ready to be shaded."""

    p: Tensor  # (3, N)
    ng: Tensor  # (3, N) unit geometric normal, on the shape's own outside
    ns: Tensor  # (3, N) unit shading normal
    tangent: Tensor | None  # (3, N) along u, neither unit nor orthogonal; None where no frame needs it
    bitangent: Tensor | None  # (3, N) along v; None without bump maps
    prim: Tensor  # (N,) below P: of a copy the triangle of its mesh
    slot: Tensor  # (N,) row of what a copy has of its own; else prim
    bound: Tensor | None  # (N,) in place of LaneGeometry.bound at prim; None where that holds everywhere
    u: Tensor  # (N,) of the primitive's own parametrization
    v: Tensor  # (N,)
    own: Tensor | None  # (3, N) point of a quadric in its own space; None where there are none
