"""Records of geometry for the search and for stages, of hits, and of surface points.

A *shape* of a scene file consists of *primitives* (a mesh of triangles, a cube of six rectangles). The scene has P primitives,
of which Q are quadrics, and I instances of meshes. ``prim`` is an index of a primitive. N is the number of *lanes*, the rays or
points that are computed together.

:class:`Geometry` is what the search reads, without gradients; :class:`LaneGeometry` is what shading reads, with gradients.
"""

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
    """The primitives for the search: float32, detached, contiguous, on one device.

    A planar primitive is the affine map ``p = p0 + u (p1 - p0) + v (p2 - p0)``: a triangle holds ``u, v >= 0, u + v <= 1``,
    a rectangle (parallelogram) ``0 <= u, v <= 1``, a disk (ellipse) ``u^2 + v^2 <= 1`` about its centre ``p0``.
    A sphere has its centre in ``p0`` and its radius in ``p1[0]``. A quadric is a surface in object space under the affine map
    ``p = p0 + x e1 + y e2 + z e3``; ``quadrics`` has it in float64.

    Attributes:
        p0: ``(3, P)`` corner or centre.
        p1: ``(3, P)``; ``e1`` for a quadric.
        p2: ``(3, P)``; ``e2`` for a quadric.
        counts: number of primitives of each of :data:`KINDS`, in the order of storage.
        quadrics: None without quadrics.
        copies: ``(15, I)`` float64: three rows of the map from a mesh to its instance, the mesh's first triangle, its number of
            triangles, and the id of the instance's first primitive; None without instances. Primitives of instances are not
            stored; they have ids after P.
    """

    p0: Tensor
    p1: Tensor
    p2: Tensor
    counts: tuple[int, int, int, int, int]
    quadrics: QuadricTable | None = None
    copies: Tensor | None = None

    @property
    def size(self) -> int:
        """Number of primitives P, without instances."""
        return sum(self.counts)


@dataclass(frozen=True)
class QuadricTable:
    """The quadrics for the search: coefficients of their equations, float64, detached."""

    frame: Tensor  # (12, Q) p0 e1 e2 e3
    form: Tensor  # (7, Q) the surface in object space, see torchpt.physics.shapes.quadrics.Form
    low: Tensor  # (3, Q) lower corner of the bounding box in the world
    high: Tensor  # (3, Q) upper corner


@dataclass(frozen=True)
class Quadrics:
    """Quadrics for stages, beside ``LaneGeometry.p0, e1, e2``: one column a quadric."""

    kinds: tuple[type[Quadric], ...]  # the kinds of surfaces; static
    code: Tensor | None  # (Q,) int64 index into `kinds`; None for a single kind
    e3: Tensor  # (3, Q) image of the z axis of object space; p0, e1 and e2 are in LaneGeometry
    n1: Tensor  # (3, Q) columns of the cofactor matrix of (e1, e2, e3), toward the front, up to a common scale
    n2: Tensor  # (3, Q)
    n3: Tensor  # (3, Q)
    coordinate_bound: Tensor  # (3, Q) largest coordinate magnitudes that enter a point's sum, see LaneGeometry.bound


@dataclass(frozen=True)
class Instances:
    """Instances of meshes. Column 0 is the identity, for all that is not instanced; column k belongs to instance k - 1.

    :attr:`Interaction.prim` indexes what instances share with the mesh (geometry); :attr:`Interaction.slot` indexes what each
    has of its own (material, opacity, object id): one row an instance, after the P rows of the primitives.
    """

    start: Tensor  # (I + 1,) int64 id of the instance's first primitive
    first: Tensor  # (I + 1,) int64 first triangle of the mesh
    x: Tensor  # (3, I + 1) first column of the linear map from the mesh to the instance
    y: Tensor  # (3, I + 1) second column
    z: Tensor  # (3, I + 1) third column
    move: Tensor  # (3, I + 1) translation
    nx: Tensor  # (3, I + 1) columns of the cofactor matrix, toward the front, up to a common scale
    ny: Tensor  # (3, I + 1)
    nz: Tensor  # (3, I + 1)


@dataclass(frozen=True)
class LaneGeometry:
    """The geometry for stages: P primitives, and I instances (see :class:`Instances`)."""

    kinds: tuple[type[Primitive], ...]  # the kinds present, in the order of KINDS; static
    counts: tuple[int, int, int, int, int]  # as in Geometry; static: stages read `ends`
    ends: Tensor  # (5,) int64 the id after the last primitive of each kind
    p0: Tensor  # (3, P) as in Geometry
    e1: Tensor  # (3, P) p1 - p0 of flat primitives; the radius in e1[0] of spheres
    e2: Tensor  # (3, P) p2 - p0
    normal: Tensor  # (3, P) unit geometric normal; zero for spheres, without meaning for quadrics
    bound: Tensor  # (P,) rounding bound: sum |n_i| max |p_i| over the primitive, the scale of rounding of its plane
    flip: Tensor | None  # (P,) -1 for spheres whose normals point inward, else 1; None without spheres
    normals: tuple[Tensor, Tensor, Tensor] | None  # (3, P) shading normals at the corners; None if all are flat
    #: (3, P) derivative of p by texture coordinate u; zero: any tangent will do. For a sphere the vector whose cross product
    #: with the normal is this derivative. None if no shading frame needs it.
    tangents: Tensor | None
    bitangents: Tensor | None  # (3, P) derivative of p by v; (pi r, 0, 0) for a sphere. None without bump maps
    uvs: tuple[Tensor, Tensor, Tensor] | None  # (2, P) texture coordinates at the corners; None without textures
    axes: tuple[Tensor, Tensor, Tensor] | None  # (3, S) unit x, y, z of the spheres; None without textures or spheres
    mirrored: Tensor | None  # (P,) bool: disks whose u and v are swapped; None if none are, or none has a texture
    colors: tuple[Tensor, Tensor, Tensor] | None  # (3, P) vertex colours at the corners; None if not read
    object_id: Tensor  # (P + I,) int64, order of the shape in the scene
    quadrics: Quadrics | None = None  # None without quadrics
    copies: Instances | None = None  # None without instances

    def slot(self, prim: Tensor) -> Tensor:
        """Return :attr:`Interaction.slot` ``(N,)`` for primitive ids of the search; -1 stays."""
        if self.copies is None:
            return prim
        import torch

        column = self.instance_column(prim)
        # Column k is instance k - 1, whose row follows those of the P = ends[4] primitives.
        return torch.where(column > 0, column + (self.ends[4] - 1), prim)

    def mask_of_kind(self, kind: type[Primitive], prim: Tensor) -> Tensor:
        """Return a mask ``(N,)`` of the primitives ``prim (N,)`` that are of a kind, one that the scene has."""
        number = KINDS.index(kind.name)
        not_before = prim >= self.ends[number - 1] if number else prim >= 0
        # Ids are sorted by kind, so the upper end needs no test if no later kind is there.
        return not_before & (prim < self.ends[number]) if any(self.counts[number + 1 :]) else not_before

    def instance_column(self, prim: Tensor) -> Tensor:
        """Return columns ``(N,)`` of :class:`Instances` for primitive ids of the search; 0 for what is not instanced."""
        import torch

        assert self.copies is not None
        return torch.searchsorted(self.copies.start[1:], prim, right=True)


@dataclass(frozen=True)
class Hit:
    """Hits of rays, as returned by the search."""

    t: Tensor  # (N,) distance in units of |d|
    prim: Tensor  # (N,) int64, -1 for a miss; P and more for triangles of instances, see Geometry.copies
    u: Tensor  # (N,) position on the primitive, by its own parametrization
    v: Tensor  # (N,)
    #: (N,) 1, with the derivative of the probability to get here past opacity; None without derivative
    chance: Tensor | None = None


@dataclass(frozen=True)
class Interaction:
    """A surface interaction: the point of a hit with its frame and parametrization."""

    p: Tensor  # (3, N)
    ng: Tensor  # (3, N) unit geometric normal, on the shape's own outside
    ns: Tensor  # (3, N) unit shading normal
    tangent: Tensor | None  # (3, N) along u, neither unit nor orthogonal; None if no shading frame needs it
    bitangent: Tensor | None  # (3, N) along v; None without bump maps
    prim: Tensor  # (N,) below P: for an instance the triangle of its mesh
    slot: Tensor  # (N,) row of the instance, see Instances; else prim
    bound: Tensor | None  # (N,) rounding bounds; None: LaneGeometry.bound at prim
    u: Tensor  # (N,) in the primitive's own parametrization
    v: Tensor  # (N,)
    own: Tensor | None  # (3, N) point in the object space of a quadric; None without quadrics
