"""Records of materials: BSDF samples, tables of materials for lanes, split-sum materials.

A lane is one path of those that are traced together: the last axis of a tensor, of length N. These records are pure data,
so that rooms may name them without importing the models.
"""

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
    """A sampled direction; the conventions stand in :mod:`torchpt.physics.bsdfs.base`."""

    wi: Tensor  # (3, N) local
    pdf: Tensor  # (N,) per steradian; 0 where sampling failed, inf for a delta lobe
    weight: Tensor  # (3, N) = eval / pdf
    eta: Tensor | None = None  # (N,) index on the side of wi over the one of wo, 1 for reflection; None: never refracts


@dataclass(frozen=True)
class LaneMaterials:
    """Materials of P primitives and I instances: M models, each with a row of parameters for every material of it.

    A lane reads the entry of its ``slot`` (:class:`~torchpt.physics.shapes.geometry.Interaction`): its primitive, or ``P`` and
    more for an instance, which may have another material than its mesh.
    """

    row: Tensor  # (P + I,) int64 row in the parameters of the model
    #: (P + I + 1,) uint8: lanes are sorted by it, so that those of one model, emissive or not, are together. Shifted by one, so
    #: that a miss (slot -1) reads the first entry.
    key: Tensor
    models: tuple[Bsdf, ...]
    parameters: tuple[Parameters, ...]  # stacked, by model; before Bsdf.prepare where the model reads textures
    textures: tuple[MaterialTextures | None, ...]  # by model; None without textures
    two_sided: tuple[Tensor | None, ...]  # by model, (rows,) bool; None where all rows are
    opacity: Tensor | None  # (P + I,) probability that a ray meets the surface; None where it is 1 everywhere


@dataclass(frozen=True)
class SplitSumMaterial:
    """Parameters of split-sum shading: radiance from prefiltered environment maps (:mod:`torchpt.physics.ibl`).

    Attributes:
        diffuse: albedo of the diffuse lobe ``(3, N)``: base colour times ``1 - metallic``.
        f0: reflectance of the specular lobe at normal incidence, ``(3, N)`` or ``(N,)``.
        f90: reflectance at grazing incidence, shaped as ``f0``.
        roughness: square root of GGX's alpha, ``(N,)`` from 0 to 1.
        over: reflectance at normal incidence, shaped as ``f0``, of a specular layer above the diffuse lobe, which loses
            that light; None: the lobes are added.
        through: colour of transmitted light ``(3, N)``; None if opaque. Needs ``over``.
        eta: index of refraction ``(N,)`` below the surface; None: light passes straight on.
    """

    diffuse: Tensor
    f0: Tensor
    f90: Tensor
    roughness: Tensor
    over: Tensor | None
    through: Tensor | None = None
    eta: Tensor | None = None
