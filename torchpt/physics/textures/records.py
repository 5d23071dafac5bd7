"""The record of a world's textures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.physics.textures import NodeMap, OpacityMaps, Table

__all__ = ["LaneTextures"]


@dataclass(frozen=True)
class LaneTextures:
    """Tables of all textures, and the textures that surfaces read for any model."""

    tables: tuple[Table, ...] = ()
    opacity: OpacityMaps | None = None  # None without textured opacity
    emission: NodeMap | None = None  # None without textured emission

    @property
    def filtered(self) -> bool:
        """True if any texture averages over footprints."""
        return any(table.filtered for table in self.tables)
