"""Where surfaces face."""

from __future__ import annotations

from torch import Tensor

from torchpt.paths.layer import Seen, SurfaceLayer
from torchpt.paths.surface import shading_normal

__all__ = ["Normal"]


class Normal(SurfaceLayer):
    """The shading normal in the world, on the shape's own outside, normal and bump maps included."""

    name = "normal"
    channels = ("normal.X", "normal.Y", "normal.Z")

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return shading_normal(seen.world, seen.model, seen.d, seen.at, seen.point)
