"""Point lights: ``Lights.p0`` is the position, ``Lights.radiance`` the radiant intensity."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from torchpt import spec
from torchpt.math.vectors import dot, inverse_square
from torchpt.physics.lights.base import Light, Row, Setting, bright
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.spec import Color, Moves

__all__ = ["Point", "toward"]


def toward(x: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit directions ``(3, N)`` from ``x (3, N)`` to points, and inverse squared distances ``(N,)``, 0 at the point."""
    to = position - x
    square = dot(to, to)
    return to / square.clamp_min(torch.finfo(square.dtype).tiny).sqrt(), inverse_square(square)


class Point(Light):
    """A point that emits alike in all directions."""

    name = "point"
    parameters: ClassVar = {
        "position": spec.Point(moves=Moves.SHADOWS, doc="position"),
        "intensity": Color((1.0, 1.0, 1.0), doc="radiant intensity: power per solid angle"),
    }
    places = ("position",)  # parameters that are points, by which the world's unit is chosen

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`."""
        color = scene.intensity("intensity")
        power = (4.0 * math.pi) * bright(color)  # `bright` is the detached luminance
        return Row(radiance=color, power=power, p0=scene.point("position"))

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        wi, weight = toward(x, at.p0)
        infinite = torch.full_like(weight, torch.inf)
        target, radiance = at.p0.expand_as(wi), at.radiance.expand_as(wi)
        return LightSample(wi=wi, target=target, distant=None, radiance=radiance, pdf=infinite, weight=weight)
