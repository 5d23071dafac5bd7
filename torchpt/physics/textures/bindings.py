"""What of textures a world holds: the tables, which node each material reads, which each surface."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.physics.textures.base import Node, Table

__all__ = ["MaterialTextures", "NodeMap", "NodePosition", "OpacityMaps", "TextureBinding", "tables_of"]


class NodePosition(NamedTuple):
    """Where a node lies: which table, and which of its rows."""

    table: int
    row: int


@dataclass(frozen=True)
class TextureBinding:
    """Which texture a material reads, for the rows of one model.

    Attributes:
        table: static; which of the world's tables.
        nodes: ``(R,)`` int64 rows of it.
        channel: static; None: a colour. Of numbers any: their nodes say which.
        filtered: static; whether any of them filters.
    """

    table: int
    nodes: Tensor
    channel: int | None
    filtered: bool = False


@dataclass(frozen=True)
class MaterialTextures:
    """What the materials of one model read from textures.

    Attributes:
        readings: :class:`TextureBinding` by parameter, nested as the parameters are.
        normal: normals in the surface's own frame, or None.
        bump: heights, or None.
        strength: ``(R,)`` how far those normals lean, as a factor; None where it is 1.
        filtered: static; whether any texture here filters.
        reads: static; what of a surface they ask for, see :attr:`torchpt.physics.textures.Node.reads`.
    """

    readings: dict[str, Any]
    normal: TextureBinding | None
    bump: TextureBinding | None
    strength: Tensor | None = None
    filtered: bool = False
    reads: tuple[str, ...] = ("uv",)


@dataclass(frozen=True)
class NodeMap:
    """Textures by primitive and copy.

    Attributes:
        nodes: ``(P + I,)`` int64 row in a table, -1 where there is none.
        tables: static; the tables that any of them lies in.
        table: ``(P + I,)`` int64 which of ``tables``; None where it is one.
    """

    nodes: Tensor
    tables: tuple[int, ...]
    table: Tensor | None


@dataclass(frozen=True)
class OpacityMaps(NodeMap):
    """Textures of opacity: ``bias + factor * value``, and where that counts as 0 or 1.

    Attributes:
        bias: ``(P + I,)``.
        factor: ``(P + I,)``.
        cutoff: ``(P + I,)``, -1 where there is none; None where there is none at all.
    """

    bias: Tensor
    factor: Tensor
    cutoff: Tensor | None


def tables_of(
    nodes: Iterable[Node], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
) -> tuple[tuple[Table, ...], dict[Node, NodePosition]]:
    """The tables of nodes, and where in them each lies; differentiable in the parameters."""
    groups: dict[Hashable, list[Node]] = {}
    places: dict[Node, NodePosition] = {}
    for node in dict.fromkeys(nodes):
        group = groups.setdefault(node.variant, [])
        places[node] = NodePosition(list(groups).index(node.variant), len(group))
        group.append(node)
    return tuple(group[0].table(group, parameters, dtype, device) for group in groups.values()), places
