"""Texture coordinates and normals of meshes: those that gradients are wanted of, and meshes that lack what texels need."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from torchpt.errors import SceneError
from torchpt.scene.parameters import Parameters
from torchpt.scene.parts import Part
from torchpt.spec import Corners

__all__ = ["check_coordinates", "declare_corners"]


def declare_corners(parts: Sequence[Part], traced: Collection[str], parameters: Parameters) -> None:
    """Make normals and texture coordinates of meshes parameters, those that are asked for by name."""
    for part in parts if traced else ():
        for key, value in (("normals", part.normals), ("uvs", part.uvs)):
            if value is not None and f"{part.name}.{key}" in traced:
                parameters.declare(f"{part.name}.{key}", value, Corners())


def check_coordinates(parts: Sequence[Part], stated: Collection[str], file: str | None) -> None:
    """Refuse texels on a mesh that does not say where they lie.

    A file's image goes over each triangle of such a mesh, as Mitsuba has it; nobody who writes down texels means that.

    Args:
        parts: all of the scene.
        stated: names of texels that the scene states itself.
        file: scene file for the error.

    Raises:
        SceneError: such a mesh, by the name of the texels.
    """
    if not stated:
        return
    from torchpt.textures.atlas import ImageNode  # scenes without texels do without it

    for part in parts:
        if part.kind != "triangle" or part.uvs is not None:
            continue
        for node in part.material.readings():
            if isinstance(node, ImageNode) and node.texels in stated:
                expected = f"uvs (texture coordinates) for {part.name}, over which the texels lie"
                raise SceneError(node.texels, "texels on a mesh without uvs", expected, file)
