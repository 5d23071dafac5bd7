"""Boundary terms of derivatives: what silhouettes and shadow edges that move add to a gradient.

``bodies`` has what moves, ``topology`` and ``sets`` the curves along which visibility may jump, ``seen`` those that the camera
sees; ``primary`` samples them. ``occluders`` has those that may throw shadows, ``lit`` points on lights, ``vertices`` what
surfaces make of light; ``shadows`` samples the edges of shadows. ``gradients`` adds it all up; ``layers`` does so for layers of
first surfaces, their interior included; ``missing`` says what is left out.
"""

from __future__ import annotations

from torchpt.edges.gradients import add_gradients, concerns
from torchpt.edges.layers import Asked, differentiable, followed
from torchpt.edges.missing import left_out, without_gradient

__all__ = ["Asked", "add_gradients", "concerns", "differentiable", "followed", "left_out", "without_gradient"]
