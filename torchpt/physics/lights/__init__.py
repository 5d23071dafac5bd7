"""Lights: emissive primitives, points, the environment; the table that chooses among them.

    sample(lights, x, which, u) -> LightSample     a point on the lights seen from x
    emitted(lights, prim, ...) -> radiance, pdf     what a ray that hit an emitter by chance brings

One kind a file: lights that are no surfaces in ``kinds/`` (:class:`Light`), surfaces that emit in ``surfaces/``
(:class:`Surface`). ``table`` puts together what they say of their rows; which row is drawn is said in ``choice``: by power, or
by the light ``tree``.
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
