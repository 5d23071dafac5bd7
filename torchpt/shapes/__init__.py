"""Shapes: from what the search found to a surface point, its normals, and points sampled on it.

Planar primitives (triangle, rectangle, disk) share one affine form; spheres are their own.
"""

from __future__ import annotations

from torchpt.shapes.interaction import interact, offset_origin, reattach
from torchpt.shapes.uv import surface_uv, vertex_colors

__all__ = ["interact", "offset_origin", "reattach", "surface_uv", "vertex_colors"]
