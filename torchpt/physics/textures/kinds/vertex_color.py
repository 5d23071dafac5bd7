"""Vertex colours, interpolated over triangles.

The surface gives the colours with each point (``TexturePoint.colors``), so the node and the table have no values of their own.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchpt.math.vectors import luminance
from torchpt.physics.textures.base import Node, Opening, Table, Texture, TexturePoint

__all__ = ["VertexColor"]


@dataclass(frozen=True)
class _Node(Node):
    """One use of vertex colours."""

    channel: int | None
    filtered: bool = False
    reads: ClassVar[str] = "colors"

    @property
    def variant(self) -> Hashable:
        return VertexColor, self.channel

    def table(
        self, nodes: Sequence[Any], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
    ) -> Table:
        return _Table(channel=self.channel)


@dataclass(frozen=True)
class _Table(Table):
    """All uses of one channel, or of the colours, whatever the mesh."""

    channel: int | None

    @property
    def count(self) -> int:
        return 0  # no values of its own

    def look_up(self, nodes: Tensor, point: TexturePoint, *, coloured: bool) -> Tensor:
        assert point.colors is not None
        if self.channel is None:
            return point.colors
        return point.colors[self.channel] if self.channel >= 0 else luminance(point.colors)


class VertexColor(Texture):
    """The vertex colours of a mesh (its file's, or its ``colors``), linear; white on surfaces without them."""

    name = "vertex_color"
    reads = "colors"

    @classmethod
    def open(cls, values: Mapping[str, Any], opening: Opening) -> Node:
        """See :meth:`Texture.open`."""
        return _Node(channel=opening.channel_index(("luminance", "r", "g", "b"), reason="vertices have no alpha"))
