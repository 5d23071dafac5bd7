"""Boundary terms of derivatives: what silhouettes and shadow edges that move add to a gradient.

``bodies`` has what moves, ``meshes`` edges of meshes, ``curves`` all curves along which visibility may jump. Estimators draw
samples of them: ``primary`` of edges that the camera sees, ``shadows`` of shadows of lights, ``segments`` of edges in light
that surfaces reflect, ``horizons`` of faces that are shaded smooth. ``receivers`` has the paths by which the camera sees what
light falls on, and how it moves; ``vertices`` what surfaces make of light; ``film`` where the camera sees points. ``traced``
draws random numbers by the samplers of renders, and traces rays by their engines. ``cotangents`` collects derivatives by all
that moves, and ``gradients`` adds it all up; ``layers`` does so for layers of first surfaces, their interior included;
``left_out`` says what none of them knows.
"""

from __future__ import annotations

from torchpt.gradients.edges.gradients import add_gradients, concerns, samples_for
from torchpt.gradients.edges.layers import Asked, differentiable, followed
from torchpt.gradients.edges.left_out import left_out, without_gradient

__all__ = [
    "Asked",
    "add_gradients",
    "concerns",
    "differentiable",
    "followed",
    "left_out",
    "samples_for",
    "without_gradient",
]
