"""Textures on the lanes: images lie in one atlas, others are computed; look-ups are differentiable.

One kind a file in ``kinds/``. ``base.py`` says what a kind, a node and a table are, ``atlas.py`` reads images, ``computed.py``
is for textures whose values are computed from coordinates, and ``bindings.py`` says which material reads what.
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
