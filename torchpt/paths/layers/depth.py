"""How far surfaces are."""

from __future__ import annotations

from torch import Tensor

from torchpt.paths.layer import Seen, SurfaceLayer

__all__ = ["Depth"]


class Depth(SurfaceLayer):
    """The distance along the camera ray."""

    name = "depth"
    channels = ("Z",)
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return seen.hit.t[None]
