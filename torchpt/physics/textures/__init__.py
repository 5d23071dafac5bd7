"""Textures: images in one atlas, and computed ones; look-ups are differentiable.

One kind a file in ``kinds/``. Read ``base.py`` first: it defines kinds, nodes and tables. ``atlas.py`` looks up images,
``computed.py`` is the base of textures computed from coordinates, and ``bindings.py`` connects materials to textures.
"""

from __future__ import annotations

from torchpt.physics.textures.base import (
    CHANNELS,
    Named,
    Node,
    Opening,
    Table,
    Texture,
    TextureInput,
    TexturePoint,
)
from torchpt.physics.textures.bindings import (
    MaterialTextures,
    NodeMap,
    NodePosition,
    OpacityMaps,
    TextureBinding,
    tables_of,
)
from torchpt.spec import Kinds

__all__ = [
    "CHANNELS",
    "KINDS",
    "MaterialTextures",
    "Named",
    "Node",
    "NodeMap",
    "NodePosition",
    "OpacityMaps",
    "Opening",
    "Table",
    "Texture",
    "TextureBinding",
    "TextureInput",
    "TexturePoint",
    "tables_of",
]

#: The kinds of textures.
KINDS: Kinds[Texture] = Kinds("torchpt.physics.textures.kinds", ("image", "checkerboard", "vertex_color"))
