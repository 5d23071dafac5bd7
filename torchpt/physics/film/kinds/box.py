"""The box filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.physics.film.filters import Filter

__all__ = ["Box"]


class Box(Filter):
    """The pixel's own square."""

    name = "box"
    jumps: ClassVar[bool] = True

    def half_width(self) -> float:
        """Return the radius in pixels: half a pixel."""
        return 0.5

    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return 1 within the pixel, 0 outside at distances ``x`` from the centre in pixels."""
        return (np.abs(x) <= self.radius).astype(np.float64)

    def offset(self, u: Tensor) -> Tensor:
        """Return offsets that are uniform over the pixel, from ``u`` in [0, 1)."""
        return (u - 0.5) * (2.0 * self._radius)

    def density(self, x: Tensor) -> Tensor:
        """Return 1 within the pixel: :meth:`Filter.density`."""
        return (x.abs() <= self._radius).to(x.dtype)

    def splat(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Return the pixel around ``x``, of weight 1: :meth:`Filter.splat`."""
        return torch.floor(x).to(torch.int64), torch.ones_like(x)
