"""Where surfaces are."""

from __future__ import annotations

from torch import Tensor

from torchpt.paths.layer import Seen, SurfaceLayer

__all__ = ["Position"]


class Position(SurfaceLayer):
    """The point in the world."""

    name = "position"
    channels = ("position.X", "position.Y", "position.Z")
    length = True

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return seen.at.p + seen.centre.to(seen.dtype)[:, None]
