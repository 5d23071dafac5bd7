"""Which shape a surface is of."""

from __future__ import annotations

from torch import Tensor

from torchpt.math.vectors import take
from torchpt.paths.layer import Seen, SurfaceLayer

__all__ = ["ObjectId"]


class ObjectId(SurfaceLayer):
    """The order of the shape in the scene, from 1; a pixel shows what its first sample met."""

    name = "object_id"
    channels = ("object_id",)
    averaged = False

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return take(seen.world.geometry.object_id, seen.at.slot).to(seen.dtype)[None]
