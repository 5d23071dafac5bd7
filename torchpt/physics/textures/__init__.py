"""Textures: images in one atlas, and computed ones; look-ups are differentiable.

One kind a file in ``kinds/``. Read ``base.py`` first: it defines kinds, nodes and tables. ``atlas.py`` looks up images,
``computed.py`` is the base of textures computed from coordinates, and ``bindings.py`` connects materials to textures.
"""

from __future__ import annotations

from torchpt.physics.textures.base import (
    CHANNELS,
    Node,
    Opening,
    Table,
    TexelSource,
    Texture,
    TextureInput,
    TexturePoint,
    TextureReference,
)
from torchpt.physics.textures.bindings import (
    MaterialTextures,
    NodeMap,
    NodePosition,
    OpacityMaps,
    TextureBinding,
    build_tables,
)
from torchpt.spec import Kinds

__all__ = [
    "CHANNELS",
    "KINDS",
    "MaterialTextures",
    "Node",
    "NodeMap",
    "NodePosition",
    "OpacityMaps",
    "Opening",
    "Table",
    "TexelSource",
    "Texture",
    "TextureBinding",
    "TextureInput",
    "TexturePoint",
    "TextureReference",
    "build_tables",
]

#: The kinds of textures by name; a module of ``kinds/`` is imported when its type is first looked up.
KINDS: Kinds[Texture] = Kinds("torchpt.physics.textures.kinds", ("image", "checkerboard", "vertex_color"))
