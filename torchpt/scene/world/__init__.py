"""Build a :class:`~torchpt.physics.world.World` of parts and parameters: one differentiable function of the parameters.

Read ``assemble.py`` first. ``primitives.py`` makes the geometry, ``materials.py`` the materials, ``emitters.py`` the light
table; ``pieces.py`` keeps what the next world can use again. :meth:`torchpt.scene.scene.Scene.world` calls :func:`assemble`.
"""

from __future__ import annotations

from torchpt.scene.world.assemble import assemble
from torchpt.scene.world.primitives import Corners, corners_of

__all__ = ["Corners", "assemble", "corners_of"]
