"""The tent filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchpt.physics.film.filters import Filter
from torchpt.spec import Scalar

__all__ = ["Tent"]


class Tent(Filter):
    """A triangle, as in Mitsuba."""

    name = "tent"
    parameters: ClassVar = {"radius": Scalar(1.0, above=0.0, doc="half width in pixels")}

    def half_width(self) -> float:
        """See :meth:`Filter.half_width`."""
        return self.values["radius"]

    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """See :meth:`Filter.profile`."""
        return np.maximum(1.0 - np.abs(x) / self.radius, 0.0)

    def offset(self, u: Tensor) -> Tensor:
        """See :meth:`Filter.offset`."""
        t = 2.0 * u - 1.0
        return torch.copysign(1.0 - (1.0 - t.abs()).sqrt(), t) * self._radius
