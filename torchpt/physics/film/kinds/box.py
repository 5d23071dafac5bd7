"""The box filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
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
