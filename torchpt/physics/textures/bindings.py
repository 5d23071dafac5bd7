"""Bindings of textures: the tables of a world, and the nodes that materials and surfaces read.

Nodes (one use of a texture each) that are looked up by the same code are the rows of a table. A binding is how a lane finds
its node: by the row of its material for parameters of BSDFs, by primitive or instance for opacity and emission. Static values
are part of compiled code, tensors its data. ``torchpt.scene.world.materials`` builds bindings, ``torchpt.paths.surface`` reads
them.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpt.physics.textures.base import Node, Table

__all__ = ["MaterialTextures", "NodeMap", "NodePosition", "OpacityMaps", "TextureBinding", "build_tables"]


class NodePosition(NamedTuple):
    """Where a node lies: index into the world's tables, and the row of that table."""

    table: int
    row: int


@dataclass(frozen=True)
class TextureBinding:
    """The textures of one parameter, for the R materials of one model that give it by a texture alike.

    Attributes:
        table: index into the world's tables; static.
        nodes: ``(R,)`` int64 rows of the table, by row of the model's parameters.
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
        bindings: :class:`TextureBinding` by parameter, nested as the parameters are.
        normal: normal map, or None.
        bump: bump map, or None.
        strength: ``(R,)`` factor of the tilt of normals; None if 1 everywhere.
        filtered: whether any texture is filtered; static.
        reads: what look-ups need from the surface, ``uv`` (texture coordinates) and ``colors`` (of vertices); static.
    """

    bindings: dict[str, Any]
    normal: TextureBinding | None
    bump: TextureBinding | None
    strength: Tensor | None = None
    filtered: bool = False
    reads: tuple[str, ...] = ("uv",)


@dataclass(frozen=True)
class NodeMap:
    """Textures of P primitives and I instances; an instance may have another material than its mesh.

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

    Bias and factor serve blends with ``null``, whose textured weight is an opacity or 1 minus one.

    Attributes:
        bias: ``(P + I,)``.
        factor: ``(P + I,)``.
        cutoff: ``(P + I,)`` opacity below it counts as 0, else as 1; -1 without; None if there is no threshold at all.
    """

    bias: Tensor
    factor: Tensor
    cutoff: Tensor | None


def build_tables(
    nodes: Iterable[Node], parameters: Mapping[str, Tensor], dtype: torch.dtype, device: torch.device
) -> tuple[tuple[Table, ...], dict[Node, NodePosition]]:
    """Build the tables of nodes, differentiable in the parameters; return them and the position of each node."""
    groups: dict[Hashable, list[Node]] = {}  # the nodes of each table, by variant
    positions: dict[Node, NodePosition] = {}
    for node in dict.fromkeys(nodes):  # each once, in their order
        group = groups.setdefault(node.variant, [])
        positions[node] = NodePosition(table=list(groups).index(node.variant), row=len(group))
        group.append(node)
    return tuple(group[0].table(group, parameters, dtype, device) for group in groups.values()), positions
