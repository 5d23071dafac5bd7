"""How much of a pixel surfaces cover."""

from __future__ import annotations

import torch
from torch import Tensor

from torchpt.paths.layer import Seen, SurfaceLayer

__all__ = ["Alpha"]


class Alpha(SurfaceLayer):
    """The share of the pixel that surfaces cover, by their opacity; 0 where the sky is seen. The picture's alpha channel."""

    name = "alpha"
    channels = ("A",)

    @classmethod
    def values(cls, seen: Seen) -> Tensor:
        """See :class:`SurfaceLayer`."""
        return torch.ones_like(seen.hit.t)[None]
