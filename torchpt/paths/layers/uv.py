"""Where textures are read."""

from __future__ import annotations

from torch import Tensor

from torchpt.paths.layer import Seen, SurfaceLayer
from torchpt.physics.shapes import surface_uv

__all__ = ["Uv"]


class Uv(SurfaceLayer):
    """Texture coordinates, before a texture's own transform."""

    name = "uv"
    channels = ("uv.U", "uv.V")
    uv = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return surface_uv(seen.world, seen.at)
