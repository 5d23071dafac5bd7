"""The constant environment: the same radiance from every direction, sampled uniformly over the sphere."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from torch import Tensor

from torchpt.math.sampling import uniform_sphere
from torchpt.physics.lights.base import Environment, EnvironmentImage, Row, Setting, bright
from torchpt.physics.lights.records import Lights, LightSample
from torchpt.spec import Color

__all__ = ["Constant"]

_INVERSE_PDF = 4.0 * math.pi


class Constant(Environment):
    """An environment of one radiance from all directions."""

    name = "constant"
    parameters: ClassVar = {"radiance": Color((1.0, 1.0, 1.0), doc="from every direction")}

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :class:`Light`; what its functions are given is the radiance ``(3,)``."""
        color, around = scene["radiance"], scene.given("radiance").to(scene.dtype)
        return Row(color, 4.0 * math.pi**2 * scene.reach**2 * bright(color), environment=around)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :class:`Light`."""
        wi = uniform_sphere(u).to(at.radiance.dtype)
        pdf, weight = (torch.full_like(wi[0], value) for value in (1.0 / _INVERSE_PDF, _INVERSE_PDF))
        return LightSample(wi, wi, None, at.radiance.expand_as(wi), pdf, weight)

    @classmethod
    def radiance_pdf(cls, around: Tensor, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """See :class:`Environment`."""
        return around[:, None].expand_as(d), torch.full_like(d[0], 1.0 / _INVERSE_PDF)

    @classmethod
    def environment_image(cls, around: Tensor) -> EnvironmentImage:
        """See :class:`Environment`."""
        return EnvironmentImage(around.expand(2, 1, 3), even=True)
