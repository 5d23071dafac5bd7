"""Textures on the lanes: one atlas of all that is read, and look-ups that are differentiable."""

from __future__ import annotations

from torchpt.textures.atlas import (
    WRAPS,
    Atlas,
    MaterialTextures,
    Node,
    OpacityMaps,
    Pyramids,
    TextureBinding,
    atlas_of,
    look_up,
    slope,
)
from torchpt.textures.reading import Reading, VertexColors

__all__ = [
    "WRAPS",
    "Atlas",
    "MaterialTextures",
    "Node",
    "OpacityMaps",
    "Pyramids",
    "Reading",
    "TextureBinding",
    "VertexColors",
    "atlas_of",
    "look_up",
    "slope",
]
