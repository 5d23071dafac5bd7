"""Directional light: ``Lights.normal`` is the direction of the light, ``Lights.radiance`` the irradiance."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import normalize
from torchpt.physics.lights.base import Light, Row, Setting, bright
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.spec import Color, Direction, Moves

__all__ = ["Directional"]


class Directional(Light):
    """Parallel light from infinitely far."""

    name = "directional"
    parameters: ClassVar = {
        "direction": Direction(moves=Moves.SHADOWS, doc="direction in which the light travels"),
        "irradiance": Color((1.0, 1.0, 1.0), doc="irradiance on a surface perpendicular to it"),
    }
    distant = True

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`."""
        color = scene["irradiance"]
        axis = normalize(scene["direction"][:, None])[:, 0]
        # Through a disk as wide as the scene, whose radius is `reach`; `bright` is the detached luminance.
        power = math.pi * scene.reach**2 * bright(color)
        return Row(radiance=color, power=power, normal=axis)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        one = torch.ones_like(u[0], dtype=at.radiance.dtype)
        wi = (-at.normal).expand(3, u.shape[1])
        radiance = at.radiance.expand_as(wi)
        return LightSample(wi=wi, target=wi, distant=None, radiance=radiance, pdf=one * torch.inf, weight=one)
