"""The records of lights: the table of them, and a point sampled on one."""

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
    """The emitters: a row for each emissive primitive, then one for each other light, sorted as ``lights.sort_key`` says.

    Columns are a primitive's own; what the others put there is said in their files in :mod:`torchpt.physics.lights.kinds`.
    """

    choice: Distribution1D | TreeSampler | None  # over the rows; None where there is but one
    kinds: tuple[str, ...]  # kinds among the rows, in their order: of KINDS, then lights
    kind: Tensor | None  # (K,) index into `kinds`; None where there is but one
    p0: Tensor  # (3, K)
    e1: Tensor  # (3, K)
    e2: Tensor  # (3, K)
    normal: Tensor  # (3, K) unit, the side that emits
    flip: Tensor  # (K,) -1 where a sphere emits inward
    area: Tensor  # (K,); of a quadric its own space's area times |det|, see torchpt.physics.lights.surfaces.quadric
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
    )  # (K, 14) float64, see torchpt.physics.lights.solid_angle.table_of; None without triangles and rectangles
    shapes: tuple[int, ...]  # codes of the shapes in `solid`; static


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
