"""Records that travel through the wave: tensors that share a lane axis.

Vectors are component-first ``(3, N)``, lane scalars ``(N,)``. A miss is ``prim = -1, t = inf``.
Directions (pbrt): ``wo`` points toward the previous vertex, ``wi`` toward the next one or the light.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from torchpt.core.tree import map_leaves
from torchpt.math.vectors import take

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.bsdfs import Bsdf, Parameters
    from torchpt.lights.choice import ByTree
    from torchpt.math.distributions import Discrete
    from torchpt.shapes.primitive import Primitive
    from torchpt.shapes.quadrics import Quadric
    from torchpt.textures import MaterialTextures, NodeMap, OpacityMaps, Table

__all__ = [
    "KINDS",
    "BsdfSample",
    "Copies",
    "Geometry",
    "Hit",
    "Interaction",
    "LaneGeometry",
    "LaneMaterials",
    "LaneTextures",
    "LightSample",
    "Lights",
    "PathState",
    "QuadricTable",
    "Quadrics",
    "Shadow",
    "SplitSumMaterial",
    "World",
    "joined",
    "rows",
]

#: Primitive kinds in the order in which a :class:`Geometry` stores them; each is a file in ``shapes/primitives/``.
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
    form: Tensor  # (7, Q) the surface in its own space, see torchpt.shapes.quadrics.Form
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
class Copies:
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
class Lights:
    """The emitters: a row for each emissive primitive, then one for each other light, sorted as ``lights.order`` says.

    Columns are a primitive's own; what the others put there is said in their files in :mod:`torchpt.lights.kinds`.
    """

    choice: Discrete | ByTree | None  # over the rows; None where there is but one
    kinds: tuple[str, ...]  # kinds among the rows, in their order: of KINDS, then lights
    kind: Tensor | None  # (K,) index into `kinds`; None where there is but one
    p0: Tensor  # (3, K)
    e1: Tensor  # (3, K)
    e2: Tensor  # (3, K)
    normal: Tensor  # (3, K) unit, the side that emits
    flip: Tensor  # (K,) -1 where a sphere emits inward
    area: Tensor  # (K,); of a quadric its own space's area times |det|, see torchpt.lights.surfaces.quadric
    bound: Tensor  # (K,) see LaneGeometry.bound
    radiance: Tensor  # (3, K); of a point or spot its intensity, of a directional light its irradiance
    opacity: Tensor | None  # (K,) of the surface that emits; None where all are opaque
    environment: Any  # what comes from outside, as the class of the last row made it; None where nothing does
    row_of_prim: Tensor | None  # (P + I,) int64, -1 where a primitive does not emit; None where none does
    quadric: (
        Tensor | None
    )  # (K,) int64 column of LaneGeometry.quadrics, 0 for the other kinds; None where no quadric emits
    quadrics: Quadrics | None  # LaneGeometry.quadrics where a quadric emits
    prim: Tensor | None  # (K,) int64 the primitive; None where no texture says how much it emits
    solid: (
        Tensor | None
    )  # (K, 14) float64, see torchpt.lights.solid_angle.table_of; None without triangles and rectangles
    shapes: tuple[int, ...]  # codes of the shapes in `solid`; static


@dataclass(frozen=True)
class LaneGeometry:
    """Places of surfaces, as the lanes gather them: P primitives, and I copies (see :class:`Copies`)."""

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
    copies: Copies | None = None  # None where there are no instances

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
class LaneMaterials:
    """Materials of surfaces: M models, and for each its materials as rows of its parameters."""

    row: Tensor  # (P + I,) int64 row in the parameters of its model
    key: Tensor  # (P + I + 1,) uint8, shifted by one so that a miss reads the first: how lanes are sorted, see path.partition
    models: tuple[Bsdf, ...]  # the BSDFs present
    parameters: tuple[Parameters, ...]  # stacked, of each model; where it reads textures, as its materials were given
    textures: tuple[MaterialTextures | None, ...]  # of each model; None where it reads none
    two_sided: tuple[Tensor | None, ...]  # (M,) bool for the rows of each model; None where all are
    opacity: Tensor | None  # (P + I,) chance that a ray meets the surface; None where it always does


@dataclass(frozen=True)
class LaneTextures:
    """The textures, and those that surfaces read whatever their model."""

    tables: tuple[Table, ...] = ()  # what is read, by the code that reads it
    opacity: OpacityMaps | None = None  # None where there are none
    emission: NodeMap | None = None  # None where there are none

    @property
    def filtered(self) -> bool:
        """Return True where any averages over a pixel's footprint."""
        return any(table.filtered for table in self.tables)


@dataclass(frozen=True)
class World:
    """A scene as the lanes gather from it: everything on one device, floats in one dtype. Absent things are ``None``."""

    geometry: LaneGeometry
    materials: LaneMaterials
    textures: LaneTextures
    lights: Lights | None  # None where nothing emits


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


@dataclass(frozen=True)
class BsdfSample:
    """A direction drawn from a BSDF."""

    wi: Tensor  # (3, N) local
    pdf: Tensor  # (N,) in solid angle; 0 where the draw failed, inf where the lobe is a delta
    weight: Tensor  # (3, N) = eval / pdf
    eta: Tensor | None = None  # (N,) index of the side of wi over that of wo, 1 for reflection; None: never refracts


@dataclass(frozen=True)
class SplitSumMaterial:
    """Properties of surfaces for split-sum shading, see :mod:`torchpt.ibl`.

    Attributes:
        diffuse: colour of the diffuse part ``(3, N)``: base colour by ``1 - metallic``.
        f0: reflectance of the mirror at normal incidence, ``(3, N)`` or ``(N,)``.
        f90: at grazing incidence, likewise.
        roughness: ``(N,)`` from 0 to 1.
        over: F0 of the mirror over the diffuse part, whose light is missing there, as ``f0``; None where the two are added.
        through: colour of what is not mirrored but passes ``(3, N)``; None where nothing does. It needs ``over``.
        eta: index of refraction ``(N,)`` of what lies below; None: light passes straight on.
    """

    diffuse: Tensor
    f0: Tensor
    f90: Tensor
    roughness: Tensor
    over: Tensor | None
    through: Tensor | None = None
    eta: Tensor | None = None


@dataclass(frozen=True)
class LightSample:
    """A point drawn on the lights, seen from a reference point."""

    wi: Tensor  # (3, N) unit, toward the light
    target: Tensor  # (3, N) end of the shadow ray, moved off the light's surface; a direction where `distant`
    distant: Tensor | None  # (N,) bool: lights infinitely far; None where there are none
    radiance: Tensor  # (3, N), zero where the draw failed; of a delta light what `weight` is to be multiplied by
    pdf: Tensor  # (N,) in solid angle, with the choice of the light, detached; inf where it is a delta
    weight: Tensor  # (N,) = 1 / pdf, differentiable in the geometry
    at: Interaction | None = None  # the point itself, without tangents; None where no texture asks for it
    bare: Tensor | None = None  # (N,) bool: where `at` has no meaning, as the light is no surface; None: nowhere
    row: Tensor | None = None  # (N,) int64 of the light in the table; None: there is but one


@dataclass(frozen=True)
class Shadow:
    """Shadow rays and what the light brings where they pass."""

    o: Tensor  # (3, N)
    d: Tensor  # (3, N)
    t_max: Tensor  # (N,) in units of |d|; 0 where the light brings nothing
    radiance: Tensor  # (3, N)


@dataclass(frozen=True)
class PathState:
    """One path a lane."""

    o: Tensor  # (3, N) ray origin
    d: Tensor  # (3, N) ray direction, unit
    t_max: Tensor  # (N,) the largest float; 0 once the path has ended
    throughput: Tensor  # (3, N)
    radiance: Tensor  # (3, N) gathered so far
    pdf: Tensor  # (N,) with which d was drawn: inf where emission counts whole, 0 where it does not count
    lane: Tensor  # (N,) int64 place in the wave
    key: Tensor  # (2, N) int32 of the sampler
    eta: Tensor | None = None  # (N,) index of refraction here over that at the camera; None where nothing refracts
    #: (3, N) the vertex that d leaves, and its normal as `lights.sample` was given it; None where the choice of lights is the
    #: same everywhere.
    p: Tensor | None = None
    n: Tensor | None = None
    #: By name what the integrator carries along, see :class:`torchpt.integrators.vertex.Field`; `(N,)` or `(rows, N)` each.
    extra: Mapping[str, Tensor] = field(default_factory=dict)


T = TypeVar("T")
R = TypeVar("R", PathState, Hit, Quadrics, Copies)


def rows(record: T, index: Tensor | None) -> T:
    """Return the lanes ``index`` of all tensors in a record (None: all); what is static stays."""
    return record if index is None else map_leaves(lambda table: take(table, index), record)


def joined(records: list[R]) -> R:
    """Records joined along the lane axis."""
    import torch

    return records[0] if len(records) == 1 else map_leaves(lambda *parts: torch.cat(parts, -1), *records)
