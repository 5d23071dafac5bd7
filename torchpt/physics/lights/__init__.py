"""Lights: emissive primitives, points, the environment; the table that chooses among them.

    sample(lights, x, which, u) -> LightSample     a point on the lights seen from x
    emitted(lights, prim, ...) -> radiance, pdf     what a ray that hit an emitter by chance brings

One kind a file: lights that are no surfaces in ``kinds/`` (:class:`Light`), surfaces that emit in ``surfaces/``
(:class:`Surface`). ``table`` puts together what they say of their rows; which row is drawn is said in ``choice``: by power, or
by the light ``tree``.
"""

from __future__ import annotations

from torchpt.physics.lights.base import COLUMNS, KINDS, Environment, EnvironmentImage, Light, Row, Setting, sort_key
from torchpt.physics.lights.choice import LIGHT_SAMPLERS, depends_on_point, light_sampler
from torchpt.physics.lights.surface import SURFACES, Faces, Surface, emitter
from torchpt.physics.lights.table import emitted, environment, environment_image, sample, without_environment
from torchpt.physics.lights.tree import from_digits

__all__ = [
    "COLUMNS",
    "KINDS",
    "LIGHT_SAMPLERS",
    "SURFACES",
    "Environment",
    "EnvironmentImage",
    "Faces",
    "Light",
    "Row",
    "Setting",
    "Surface",
    "depends_on_point",
    "emitted",
    "emitter",
    "environment",
    "environment_image",
    "from_digits",
    "light_sampler",
    "sample",
    "sort_key",
    "without_environment",
]  # fmt: skip
