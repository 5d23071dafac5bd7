"""Lights: emissive primitives, points, the environment; the table that chooses among them by power.

    sample(lights, x, choice, u) -> LightSample     a point on the lights seen from x
    emitted(lights, prim, ...) -> radiance, pdf     what a ray that hit an emitter by chance brings

One kind a file: ``area`` (triangle, rectangle, disk), ``sphere``, ``quadric``, ``point``, ``spot``, ``constant``,
``envmap``; of a directional light there is nothing to compute.
"""

from __future__ import annotations

from torchpt.lights.table import emitted, environment, sample

__all__ = ["emitted", "environment", "sample"]
