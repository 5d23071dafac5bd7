"""Points that shine alike in all directions: a position in ``Lights.p0``, an intensity in ``Lights.radiance``."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from torchpt import spec
from torchpt.lights.base import Light
from torchpt.math.vectors import dot, safe_reciprocal
from torchpt.spec import Color, Moves

__all__ = ["Point", "toward"]


def toward(x: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions ``(3, N)`` from ``x (3, N)`` to points, and one over the squared distances ``(N,)``; 0 at the point."""
    to = position - x
    square = dot(to, to)
    return to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt(), safe_reciprocal(square)


class Point(Light):
    """A point that shines alike in all directions."""

    name = "point"
    parameters: ClassVar = {
        "position": spec.Point(moves=Moves.SHADOWS, doc="where it is"),
        "intensity": Color((1.0, 1.0, 1.0), doc="power per solid angle"),
    }
