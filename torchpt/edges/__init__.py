"""Boundary terms of derivatives: what silhouettes and shadow edges that move add to a gradient.

``bodies`` has what moves, ``topology`` and ``sets`` the curves along which visibility may jump, ``seen`` those that the camera
sees; ``primary`` samples them, ``gradients`` adds it all up.
"""

from __future__ import annotations

from torchpt.edges.gradients import add_gradients, concerns

__all__ = ["add_gradients", "concerns"]
