"""Layers without light transport: engines evaluate them at first surfaces (:mod:`torchpt.paths.layers`)."""

from __future__ import annotations

from torchpt.paths.integrators.base import Integrator

__all__ = ["Aov"]


class Aov(Integrator):
    """The layers of ``film.aovs`` without any light transport; the picture shows the first of them."""

    name = "aov"
    light = False
    layers = ("albedo",)
