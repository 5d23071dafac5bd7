"""Build a :class:`~torchpt.physics.world.World` of parts and parameters: one differentiable function of the parameters."""

from __future__ import annotations

from torchpt.scene.world.assemble import assemble
from torchpt.scene.world.primitives import Corners, corners_of

__all__ = ["Corners", "assemble", "corners_of"]
