"""The records of materials: what lanes read of them, sampled directions, and what the preview shades with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.physics.bsdfs.base import Bsdf, Parameters
    from torchpt.physics.textures import MaterialTextures

__all__ = ["BsdfSample", "LaneMaterials", "SplitSumMaterial"]


@dataclass(frozen=True)
class BsdfSample:
    """A direction drawn from a BSDF."""

    wi: Tensor  # (3, N) local
    pdf: Tensor  # (N,) in solid angle; 0 where the draw failed, inf where the lobe is a delta
    weight: Tensor  # (3, N) = eval / pdf
    eta: Tensor | None = None  # (N,) index of the side of wi over that of wo, 1 for reflection; None: never refracts


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
