"""Lights: emissive primitives, points, the environment; the table that chooses among them.

    sample(lights, x, which, u) -> LightSample     a point on the lights seen from x
    emitted(lights, prim, ...) -> radiance, pdf     what a ray that hit an emitter by chance brings

One kind a file: ``area`` (triangle, rectangle, disk), ``sphere``, ``quadric``, ``point``, ``spot``, ``constant``,
``envmap``; of a directional light there is nothing to compute. Which light is drawn is said in ``choice``: by power, or by
the light ``tree``.
"""

from __future__ import annotations

from torchpt.lights.base import Light
from torchpt.lights.choice import WAYS, choice_of, local
from torchpt.lights.table import emitted, environment, sample
from torchpt.lights.tree import fine
from torchpt.spec import Kinds

#: The kinds of lights that are no surfaces.
KINDS: Kinds[Light] = Kinds("torchpt.lights.kinds", ("point", "spot", "directional", "constant", "envmap"))

__all__ = ["KINDS", "WAYS", "Light", "choice_of", "emitted", "environment", "fine", "local", "sample"]
