"""The environment maps of several scenes, one after another, and what of them the lanes of each scene read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchpt.math.distributions import Spans
from torchpt.math.vectors import take

if TYPE_CHECKING:
    from torchpt.lights.kinds.envmap import EnvironmentMap, Grid

__all__ = ["joined", "of"]


def joined(maps: Sequence[EnvironmentMap]) -> EnvironmentMap:
    """The maps of S scenes, for :func:`of`; numbers of a map are ``(..., S)``."""
    heights, texels = [map.height for map in maps], [map.texels.shape[1] for map in maps]
    begin = [[*accumulate(sizes, initial=0)][:-1] for sizes in (texels, heights, [height - 1 for height in heights])]
    finer = [map.compensated for map in maps if map.compensated is not None]
    return replace(
        maps[0],
        texels=torch.cat([map.texels for map in maps], 1),
        height=max(heights),
        width=max(map.width for map in maps),
        size=torch.stack([map.size for map in maps], 1),
        turn=torch.stack([map.turn for map in maps], 2),
        scale=torch.stack([map.scale for map in maps]),
        halves=torch.cat([map.halves for map in maps], 1),
        steps=torch.cat([map.steps for map in maps]),
        plain=_joined([map.plain for map in maps]),
        compensated=_joined(finer) if finer else None,
        starts=torch.tensor(begin, device=maps[0].texels.device),
    )


def _joined(grids: Sequence[Grid]) -> Grid:
    cells = [grid.cells for grid in grids]
    device = cells[0].rows.device
    every = replace(
        cells[0],
        rows=torch.cat([own.rows for own in cells]),
        columns=torch.cat([own.columns for own in cells]),
        width=torch.stack([own.width for own in cells]),
        spans=(
            Spans.of([len(own.rows) for own in cells], device),
            Spans.of([len(own.columns) for own in cells], device),
        ),
    )
    floor, factor = torch.stack([grid.floor for grid in grids]), torch.stack([grid.factor for grid in grids])
    return replace(grids[0], cells=every, floor=floor, factor=factor)


def of(maps: EnvironmentMap, scene: Tensor) -> EnvironmentMap:
    """Of what was :func:`joined` the numbers that lanes of scenes ``(N,)`` have, in place of those of one map."""
    own = {name: take(getattr(maps, name), scene) for name in ("size", "scale", "starts")}
    turn = take(maps.turn.reshape(9, -1), scene).view(3, 3, -1)
    finer = None if maps.compensated is None else _of(maps.compensated, scene)
    return replace(maps, **own, turn=turn, plain=_of(maps.plain, scene), compensated=finer)


def _of(grid: Grid, scene: Tensor) -> Grid:
    cells = replace(grid.cells, width=take(grid.cells.width, scene), which=scene)
    return replace(grid, cells=cells, floor=take(grid.floor, scene), factor=take(grid.factor, scene))
