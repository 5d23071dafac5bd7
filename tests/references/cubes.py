"""The triangles of the unit cube."""

from __future__ import annotations

from torchpt.physics.shapes import KINDS
from torchpt.scene.meshes import MeshPart

__all__ = ["unit_cube"]


def unit_cube() -> MeshPart:
    """Return the triangles of the shape ``cube``."""
    cube = KINDS["cube"].triangles({})
    assert cube is not None and cube.vertices is not None and cube.faces is not None
    return MeshPart("", cube.vertices, cube.faces, cube.normals, cube.uvs)
