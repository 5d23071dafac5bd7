"""Shapes and their primitives: scene parameters, surface points of hits, normals and texture coordinates.

Shapes of scene files stand in ``kinds/``, primitives in ``primitives/``, one a file. ``interaction`` turns hits into surface
points. Planar primitives (triangle, rectangle, disk) share one affine form.
"""

from __future__ import annotations

from torchpt.physics.shapes.base import Shape
from torchpt.physics.shapes.interaction import interact, offset_origin, reattach
from torchpt.physics.shapes.uv import surface_uv, vertex_colors
from torchpt.spec import Kinds

#: The kinds of shapes.
KINDS: Kinds[Shape] = Kinds(
    "torchpt.physics.shapes.kinds", ("mesh", "sphere", "rectangle", "disk", "cube", "cylinder", "cone", "instance")
)

__all__ = ["KINDS", "Shape", "interact", "offset_origin", "reattach", "surface_uv", "vertex_colors"]
