"""The tent filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.physics.film.filters import MAX_WIDTH, Filter
from torchpt.spec import Scalar

__all__ = ["Tent"]


class Tent(Filter):
    """A triangle, as in Mitsuba."""

    name = "tent"
    parameters: ClassVar = {"radius": Scalar(1.0, above=0.0, high=MAX_WIDTH, doc="half width in pixels")}

    def half_width(self) -> float:
        """Return the radius in pixels: the parameter ``radius``."""
        return self.values["radius"]

    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the triangle at distances ``x`` from the centre in pixels."""
        return np.maximum(1.0 - np.abs(x) / self.radius, 0.0)

    def offset(self, u: Tensor) -> Tensor:
        """Return offsets distributed as the triangle, from ``u`` in [0, 1): the inverse CDF, both halves at once."""
        t = 2.0 * u - 1.0
        return torch.copysign(1.0 - (1.0 - t.abs()).sqrt(), t) * self._radius

    def density(self, x: Tensor) -> Tensor:
        """Return the triangle, of integral 1, at distances ``x`` from the centre: :meth:`Filter.density`."""
        return (1.0 - x.abs() / self._radius).clamp_min(0.0) / self._radius
