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

_INVERSE_PDF = 4.0 * math.pi  # steradians of the sphere


class Constant(Environment):
    """An environment of one radiance from all directions."""

    name = "constant"
    parameters: ClassVar = {"radiance": Color((1.0, 1.0, 1.0), doc="radiance from every direction")}

    @classmethod
    def row(cls, scene: Setting) -> Row:
        """See :meth:`Light.row`; :attr:`Row.environment` is the radiance ``(3,)``."""
        color, around = scene["radiance"], scene.given("radiance").to(scene.dtype)
        # From each direction through a disk as wide as the scene, whose radius is `reach`; `bright` is the detached luminance.
        power = 4.0 * math.pi**2 * scene.reach**2 * bright(color)
        return Row(radiance=color, power=power, environment=around)

    @classmethod
    def sample(cls, at: Lights, x: Tensor, u: Tensor, mis: bool) -> LightSample:
        """See :meth:`Light.sample`."""
        wi = uniform_sphere(u).to(at.radiance.dtype)
        pdf, weight = (torch.full_like(wi[0], value) for value in (1.0 / _INVERSE_PDF, _INVERSE_PDF))
        return LightSample(wi=wi, target=wi, distant=None, radiance=at.radiance.expand_as(wi), pdf=pdf, weight=weight)

    @classmethod
    def radiance_pdf(cls, around: Tensor, d: Tensor, mis: bool) -> tuple[Tensor, Tensor]:
        """See :meth:`Environment.radiance_pdf`."""
        return around[:, None].expand_as(d), torch.full_like(d[0], 1.0 / _INVERSE_PDF)

    @classmethod
    def environment_image(cls, around: Tensor) -> EnvironmentImage:
        """See :meth:`Environment.environment_image`."""
        # Two rows, both poles: the least that the layout of environment maps allows.
        return EnvironmentImage(texels=around.expand(2, 1, 3), even=True)
