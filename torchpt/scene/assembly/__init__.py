"""From parts and parameters to a :class:`~torchpt.records.World`: one differentiable function of the parameters."""

from __future__ import annotations

from torchpt.scene.assembly.corners import Corners, corners_of
from torchpt.scene.assembly.world import assemble

__all__ = ["Corners", "assemble", "corners_of"]
