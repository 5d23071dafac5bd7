"""Records of lights: the light table and light samples.

The table has K rows, one for each of E emissive primitives (triangle, sphere, ...) and one for each light without a surface.
A row is a column of the tensors below, whose last axis is K. P and I are the numbers of primitives and of instances of the
scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.math.sampling import Distribution1D
    from torchpt.physics.lights.choice import TreeSampler
    from torchpt.physics.shapes.geometry import Interaction, Quadrics

__all__ = ["LightSample", "Lights"]


@dataclass(frozen=True)
class Lights:
    """The light table: a row for each emissive primitive, then one for each other light, sorted by ``lights.sort_key``.

    Columns are those of primitives; the files of :mod:`torchpt.physics.lights.kinds` say what other lights keep in them.
    """

    choice: Distribution1D | TreeSampler | None  # the light sampler; None for a single row
    kinds: tuple[str, ...]  # kinds of the rows, in their order: of SURFACES, then of KINDS
    kind: Tensor | None  # (K,) index into `kinds`; None for a single row
    p0: Tensor  # (3, K) corner or centre of the primitive, as in LaneGeometry; position of a point or spot light
    e1: Tensor  # (3, K) first edge of the primitive, p0 + u e1 + v e2
    e2: Tensor  # (3, K) second edge
    normal: Tensor  # (3, K) unit, the side that emits
    flip: Tensor  # (K,) -1 where a sphere emits inward
    #: (K,) area in the world; for a quadric the area in object space times |det|, see torchpt.physics.lights.surfaces.quadric
    area: Tensor
    bound: Tensor  # (K,) rounding bound, see LaneGeometry.bound
    power: Tensor  # (K,) float64, emitted power as luminance, detached
    radiance: Tensor  # (3, K); intensity of a point or spot light, irradiance of a directional light
    opacity: Tensor | None  # (K,) opacity of the emissive surface; None if all are opaque
    environment: Any  # Row.environment of the last row; None without an environment
    row_of_prim: Tensor | None  # (P + I,) int64 row by Interaction.slot; -1 if it does not emit; None if none emits
    quadric: Tensor | None  # (K,) int64 column of LaneGeometry.quadrics, 0 for other kinds; None if no quadric emits
    quadrics: Quadrics | None  # LaneGeometry.quadrics if a quadric emits
    prim: Tensor | None  # (K,) int64 primitive of each row, an index below P; None without textured emission
    #: (K, 14) float64, for sampling by solid angle, see torchpt.physics.lights.solid_angle.table_of; None without triangles and
    #: rectangles
    solid: Tensor | None
    shapes: tuple[int, ...]  # codes of the shapes in `solid`; static


@dataclass(frozen=True)
class LightSample:
    """A light sample: a point on a light, seen from a reference point."""

    wi: Tensor  # (3, N) unit, toward the light
    target: Tensor  # (3, N) end of the shadow ray, moved off the light's surface; a direction where `distant`
    #: (N,) bool; None without distant lights. A kind's own samples have None: `torchpt.physics.lights.table` sets the mask.
    distant: Tensor | None
    radiance: Tensor  # (3, N), zero where sampling failed; for a delta light the intensity or irradiance
    pdf: Tensor  # (N,) per steradian, times the probability of the light, detached; inf for a delta light
    weight: Tensor  # (N,) = 1 / pdf, differentiable in the geometry
    at: Interaction | None = None  # the point, without tangents; None without textured emission
    bare: Tensor | None = None  # (N,) bool: the light has no surface, so `at` is meaningless; None: nowhere
    row: Tensor | None = None  # (N,) int64 row in the light table; None for a single row
    normal: Tensor | None = None  # (3, N) unit, on the emitting side; None where no surface emits
