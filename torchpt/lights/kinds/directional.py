"""Parallel light from infinitely far: where it goes in ``Lights.normal``, an irradiance in ``Lights.radiance``."""

from __future__ import annotations

from typing import ClassVar

from torchpt.lights.base import Light
from torchpt.spec import Color, Direction, Moves

__all__ = ["Directional"]


class Directional(Light):
    """Parallel light from infinitely far."""

    name = "directional"
    parameters: ClassVar = {
        "direction": Direction(moves=Moves.SHADOWS, doc="where the light goes"),
        "irradiance": Color((1.0, 1.0, 1.0), doc="on a surface that faces it"),
    }
    distant = True
