"""What surfaces reflect."""

from __future__ import annotations

from torch import Tensor

from torchpt.math.vectors import take
from torchpt.paths.layer import Seen, SurfaceLayer
from torchpt.paths.surface import parameters_at

__all__ = ["Albedo"]


class Albedo(SurfaceLayer):
    """The material's reflectance, textures included."""

    name = "albedo"
    channels = ("albedo.R", "albedo.G", "albedo.B")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        materials = seen.world.materials
        parameters = parameters_at(seen.world, seen.model, take(materials.row, seen.at.slot), seen.at, seen.point)
        return materials.models[seen.model].albedo(parameters)
