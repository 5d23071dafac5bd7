"""Mitchell and Netravali's filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchpt.physics.film.filters import Tabulated
from torchpt.spec import Scalar

__all__ = ["Mitchell"]


class Mitchell(Tabulated):
    """Mitchell and Netravali's cubic of radius 2, with Mitsuba's names; its outer lobes are negative for ``C`` > 0.

    *Reconstruction Filters in Computer Graphics*, SIGGRAPH 1988, equation 8. The integral is 1.
    """

    name = "mitchell"
    parameters: ClassVar = {
        "B": Scalar(1 / 3, high=1.0, doc="amount of blur"),
        "C": Scalar(1 / 3, high=1.0, doc="amount of ringing at edges"),
    }

    def half_width(self) -> float:
        """Return the radius in pixels: 2, where the cubic ends."""
        return 2.0

    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the cubic at distances ``x`` from the centre in pixels."""
        b, c = self.values["B"], self.values["C"]
        x = np.abs(x)
        inner = (12 - 9 * b - 6 * c) * x**3 + (-18 + 12 * b + 6 * c) * x**2 + (6 - 2 * b)
        outer = (-b - 6 * c) * x**3 + (6 * b + 30 * c) * x**2 + (-12 * b - 48 * c) * x + (8 * b + 24 * c)
        return np.where(x < 1, inner, np.where(x < 2, outer, 0.0)) / 6
