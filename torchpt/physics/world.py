"""The world: all tensors of a scene that stages read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchpt.physics.bsdfs.records import LaneMaterials
    from torchpt.physics.lights.emission import Emission
    from torchpt.physics.lights.records import Lights
    from torchpt.physics.shapes.geometry import LaneGeometry
    from torchpt.physics.textures.records import LaneTextures

__all__ = ["World"]


@dataclass(frozen=True)
class World:
    """All tensors of a scene that stages read, on one device, floats in one dtype. Fields of absent features are ``None``."""

    geometry: LaneGeometry
    materials: LaneMaterials
    textures: LaneTextures
    lights: Lights | None  # None if nothing emits
    emission: Emission | None = None  # where light paths start; None where there are none
