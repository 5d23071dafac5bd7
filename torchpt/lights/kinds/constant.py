"""The constant environment: the same radiance from every direction, sampled uniformly over the sphere."""

from __future__ import annotations

import math
from typing import ClassVar

from torch import Tensor

from torchpt.lights.base import Light
from torchpt.math.warps import uniform_sphere
from torchpt.spec import Color

__all__ = ["INVERSE_PDF", "Constant", "sample"]

INVERSE_PDF = 4.0 * math.pi


def sample(u: Tensor) -> Tensor:
    """Unit directions ``(3, N)`` toward the environment."""
    return uniform_sphere(u)


class Constant(Light):
    """An environment of one radiance from all directions."""

    name = "constant"
    parameters: ClassVar = {"radiance": Color((1.0, 1.0, 1.0), doc="from every direction")}
    distant = True
    environment = True
