"""What stands in place of a number or a colour: an image read at points, or the colours of a mesh's vertices."""

from __future__ import annotations

from dataclasses import dataclass

from torchpt.textures.atlas import Node

__all__ = ["Reading", "VertexColors"]


@dataclass(frozen=True)
class VertexColors:
    """The colours of a mesh's vertices in place of a number or colour; ``channel`` as of a node."""

    channel: int | None


#: A texture in place of a number or a colour.
Reading = Node | VertexColors
