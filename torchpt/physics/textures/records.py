"""The record of a world's textures, which stages look values up in; ``torchpt.scene.world`` builds it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.physics.textures import NodeMap, OpacityMaps, Table

__all__ = ["LaneTextures"]


@dataclass(frozen=True)
class LaneTextures:
    """Tables of all textures, and those that surfaces read whatever their BSDF; BSDFs keep their own bindings."""

    tables: tuple[Table, ...] = ()  # textures that are looked up by the same code lie in one table
    opacity: OpacityMaps | None = None  # None without textured opacity
    emission: NodeMap | None = None  # None without textured emission

    @property
    def filtered(self) -> bool:
        """True if any texture averages over footprints."""
        return any(table.filtered for table in self.tables)
