"""The textures of a scene as lanes read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.physics.textures import NodeMap, OpacityMaps, Table

__all__ = ["LaneTextures"]


@dataclass(frozen=True)
class LaneTextures:
    """The textures, and those that surfaces read whatever their model."""

    tables: tuple[Table, ...] = ()  # what is read, by the code that reads it
    opacity: OpacityMaps | None = None  # None where there are none
    emission: NodeMap | None = None  # None where there are none

    @property
    def filtered(self) -> bool:
        """Return True where any averages over a pixel's footprint."""
        return any(table.filtered for table in self.tables)
