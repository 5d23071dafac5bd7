"""The store: vertices of light paths that camera paths are connected to.

The light path of a sample leaves one of its vertices in each *block* of the store, chosen at random among all of them, the same
as every other (reservoir sampling: vertex k replaces the one before with probability 1/k). A vertex of the sample's camera path
is connected to the vertex of one block, times the number of vertices that it was chosen from. So the work is that of one
connection a vertex, and memory does not depend on the length of paths; both are a function of the sample alone. The blocks take
turns along a camera path, so that its vertices are connected to different ones.

Rows of a block have the names below, and those of the fields of the light path.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchpt.paths.state import EXTRA, Partner, StoredVertex, VertexInput
from torchpt.paths.wave import camera_state
from torchpt.physics.shapes.geometry import Hit

__all__ = ["BLOCKS", "PARTNER", "VertexStore", "block_of", "kept_values", "partner_of", "vertex_of"]

#: Number of blocks.
BLOCKS = 4
#: Rows of a block that a vertex of a camera path reads.
PARTNER = ("model", "depth", "count", "p")
_STATE = ("o", "d", "throughput", "key")
_HIT = ("t", "prim", "u", "v")


def block_of(depth: int) -> int:
    """Return the block that vertex ``depth`` of a camera path is connected to."""
    return depth % BLOCKS


def kept_values(vertex: VertexInput, kept: StoredVertex) -> dict[str, Tensor]:
    """Return what a block holds of vertices, by row, and ``count``, which all blocks hold."""
    state, hit = vertex.state, vertex.hit
    like = hit.prim

    def whole(value: int | Tensor) -> Tensor:
        return torch.zeros_like(like) + value

    values = {"model": whole(kept.model), "depth": whole(kept.depth), "count": whole(kept.count), "p": kept.p}
    values |= {name: getattr(state, name) for name in _STATE}
    values |= {EXTRA + name: value for name, value in state.extra.items()} | {f"{EXTRA}dvcm": kept.dvcm}
    return values | {name: getattr(hit, name) for name in _HIT}


def partner_of(values: Mapping[str, Tensor]) -> Partner:
    """Return what a vertex of a camera path needs to know of its partner, from rows of a block."""
    return Partner(**{name: values[name] for name in PARTNER})


def vertex_of(values: Mapping[str, Tensor]) -> VertexInput:
    """Return vertices of light paths from rows of a block, with as much of their paths as was kept."""
    state = camera_state(values["o"], values["d"], values["key"])
    extra = {name.removeprefix(EXTRA): value for name, value in values.items() if name.startswith(EXTRA)}
    state = replace(state, throughput=values["throughput"], extra=extra)
    return VertexInput(state, Hit(**{name: values[name] for name in _HIT}))


class VertexStore:
    """The store of the engine of tensors.

    Args:
        lanes: number of samples.
    """

    def __init__(self, lanes: int) -> None:
        self._lanes = lanes
        self._blocks: list[dict[str, Tensor]] = [{} for _ in range(BLOCKS)]
        self._count: Tensor | None = None

    def keep(self, lane: Tensor, vertex: VertexInput, kept: StoredVertex) -> None:
        """Keep vertices of the samples ``lane (n,)`` in the blocks that they were chosen for."""
        values = kept_values(vertex, kept)
        count = values.pop("count")
        if self._count is None:
            self._count = torch.zeros(self._lanes, dtype=torch.int64, device=lane.device)
            for block in self._blocks:
                block |= {
                    name: torch.zeros(*x.shape[:-1], self._lanes, dtype=x.dtype, device=x.device)
                    for name, x in values.items()
                }
        self._count[lane] = count
        for block, where in zip(self._blocks, kept.where, strict=True):
            index = where.nonzero().squeeze(1)
            for name, value in values.items():
                block[name].index_copy_(-1, lane[index], value.index_select(-1, index))

    def read(self, lane: Tensor, depth: int) -> dict[str, Tensor] | None:
        """Return the rows of the block for vertex ``depth`` of the samples ``lane (n,)``; None: it is empty."""
        if self._count is None:
            return None
        block: dict[str, Any] = self._blocks[block_of(depth)]
        values = {name: value.index_select(-1, lane) for name, value in block.items()}
        return {**values, "count": self._count[lane]}
