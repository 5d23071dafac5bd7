"""Bindings of textures: the tables of a world, and the nodes that materials and surfaces read."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.physics.textures.base import Node, Table

__all__ = ["MaterialTextures", "NodeMap", "NodePosition", "OpacityMaps", "TextureBinding", "tables_of"]


class NodePosition(NamedTuple):
    """The table and the row of a node."""

    table: int
    row: int


@dataclass(frozen=True)
class TextureBinding:
    """The textures of one parameter, for the rows of one model.

    Attributes:
        table: index into the world's tables; static.
        nodes: ``(R,)`` int64 rows of the table.
        channel: None for a colour, any channel for a number, as nodes have their own; static.
        filtered: whether any node is filtered; static.
    """

    table: int
    nodes: Tensor
    channel: int | None
    filtered: bool = False


@dataclass(frozen=True)
class MaterialTextures:
    """The textures of the materials of one model.

    Attributes:
        readings: :class:`TextureBinding` by parameter, nested as the parameters are.
        normal: normal map, or None.
        bump: bump map, or None.
        strength: ``(R,)`` factor of the tilt of normals; None if 1 everywhere.
        filtered: whether any texture is filtered; static.
        reads: inputs from the surface, see :attr:`torchpt.physics.textures.Node.reads`; static.
    """

    readings: dict[str, Any]
    normal: TextureBinding | None
    bump: TextureBinding | None
    strength: Tensor | None = None
    filtered: bool = False
    reads: tuple[str, ...] = ("uv",)


@dataclass(frozen=True)
class NodeMap:
    """Textures by primitive and instance.

    Attributes:
        nodes: ``(P + I,)`` int64 row in a table, -1 without a texture.
        tables: indices of the tables in use; static.
        table: ``(P + I,)`` int64 index into ``tables``; None for a single table.
    """

    nodes: Tensor
    tables: tuple[int, ...]
    table: Tensor | None


@dataclass(frozen=True)
class OpacityMaps(NodeMap):
    """Textures of opacity: ``bias + factor * value``, optionally thresholded to 0 or 1.

    Attributes:
        bias: ``(P + I,)``.
        factor: ``(P + I,)``.
        cutoff: ``(P + I,)`` threshold, -1 without; None if there is no threshold at all.
    """

    bias: Tensor
    factor: Tensor
    cutoff: Tensor | None


def tables_of(
    nodes: Iterable[Node], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
) -> tuple[tuple[Table, ...], dict[Node, NodePosition]]:
    """Build the tables of nodes, differentiable in the parameters; return them and the position of each node."""
    groups: dict[Hashable, list[Node]] = {}
    places: dict[Node, NodePosition] = {}
    for node in dict.fromkeys(nodes):
        group = groups.setdefault(node.variant, [])
        places[node] = NodePosition(list(groups).index(node.variant), len(group))
        group.append(node)
    return tuple(group[0].table(group, parameters, dtype, device) for group in groups.values()), places
