"""Lights: emissive surfaces, delta lights, the environment, and how one of them is sampled.

    sample(lights, x, which, u) -> LightSample     a point on the lights seen from x
    emitted(lights, x, ...) -> radiance, pdf        emission of a surface that a ray hit

One kind a file: lights without a surface in ``kinds/`` (:class:`Light`), emissive primitives in ``surfaces/``
(:class:`Surface`). ``table`` samples the table of all lights; ``choice`` chooses its row: uniformly, by power, or by the light
``tree``.
"""

from __future__ import annotations

from torchpt.physics.lights.base import COLUMNS, KINDS, Environment, Light, Row, Setting, Surroundings, order
from torchpt.physics.lights.choice import WAYS, choice_of, local
from torchpt.physics.lights.surface import SURFACES, Faces, Surface, emitter
from torchpt.physics.lights.table import emitted, environment, sample, surroundings, without_environment
from torchpt.physics.lights.tree import fine

__all__ = [
    "COLUMNS", "KINDS", "SURFACES", "WAYS", "Environment", "Faces", "Light", "Row", "Setting", "Surface", "Surroundings",
    "choice_of", "emitted", "emitter", "environment", "fine", "local", "order", "sample", "surroundings",
    "without_environment",
]  # fmt: skip
