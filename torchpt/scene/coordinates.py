"""Texels that a scene states itself lie by texture coordinates: a mesh without any is refused, once all materials are known."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from torchpt.errors import SceneError
from torchpt.scene.parts import Part
from torchpt.textures.atlas import ImageNode

__all__ = ["check_coordinates"]


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
    for part in parts if stated else ():
        if part.kind != "triangle" or part.uvs is not None:
            continue
        for node in part.material.readings():
            if isinstance(node, ImageNode) and node.texels in stated:
                expected = f"uvs (texture coordinates) for {part.name}, over which the texels lie"
                raise SceneError(node.texels, "texels on a mesh without uvs", expected, file)
