"""The gaussian filter."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchpt.physics.film.filters import MAX_WIDTH, Tabulated
from torchpt.spec import Scalar

__all__ = ["Gaussian"]


class Gaussian(Tabulated):
    """A truncated gaussian, as in Mitsuba: ``exp(-x^2 / 2 stddev^2)`` minus its value at ``radius``."""

    name = "gaussian"
    parameters: ClassVar = {
        "stddev": Scalar(0.5, above=0.0, high=MAX_WIDTH, doc="standard deviation in pixels"),
        "radius": Scalar(
            lambda values: 4.0 * values["stddev"],
            above=0.0,
            high=4.0 * MAX_WIDTH,
            doc="half width in pixels; 4 `stddev` by default",
        ),
    }

    def half_width(self) -> float:
        """Return the radius in pixels: the parameter ``radius``."""
        return self.values["radius"]

    def profile(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the truncated gaussian at distances ``x`` from the centre in pixels."""
        stddev, radius = self.values["stddev"], self.values["radius"]
        return np.maximum(np.exp(-0.5 * (x / stddev) ** 2) - np.exp(-0.5 * (radius / stddev) ** 2), 0.0)
