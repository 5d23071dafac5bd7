"""Pilots: one pixel of each block of 4 x 4 that is sampled a second time, by other random numbers.

The difference of two independent values of a pixel is its error, whatever sampler made them. Where the pilots lie depends on
the seed and on the film alone: a crop has those of the whole film that lie in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.hashing import as_int32, mix, mix_int, to_unit

__all__ = ["BLOCK", "Pilots", "pilots_of"]

#: Side of a block in pixels.
BLOCK = 4
_NAME = 0x50494C4F


@dataclass(frozen=True)
class Pilots:
    """The pilots of a picture; n of them, one for each block of which it holds the pilot.

    Attributes:
        places: which pixels they are ``(n,)`` int64, row by row.
        weight: pixels that each stands for ``(n,)`` float64.
        block: row and column of their blocks ``(2, n)`` int64.
        blocks: rows and columns of blocks that the picture touches.
        corner: of the picture within its first block, ``(x, y)`` in pixels.
    """

    places: Tensor
    weight: Tensor
    block: Tensor
    blocks: tuple[int, int]
    corner: tuple[int, int]

    def __len__(self) -> int:
        return len(self.places)


def pilots_of(seed: int, film: tuple[int, int], crop: tuple[int, int, int, int]) -> Pilots:
    """The pilots of a crop ``(x, y, width, height)`` of a film ``(width, height)``."""
    x0, y0, width, height = crop
    first = x0 // BLOCK, y0 // BLOCK
    columns, rows = -(-(x0 + width) // BLOCK) - first[0], -(-(y0 + height) // BLOCK) - first[1]
    row, column = (
        grid.reshape(-1)
        for grid in torch.meshgrid(torch.arange(rows) + first[1], torch.arange(columns) + first[0], indexing="ij")
    )
    # Blocks at the film's edge hold fewer pixels.
    wide, high = (film[0] - BLOCK * column).clamp_max(BLOCK), (film[1] - BLOCK * row).clamp_max(BLOCK)
    number = (row * -(-film[0] // BLOCK) + column).to(torch.int32)
    named = as_int32(mix_int(mix_int(seed) ^ as_int32(seed >> 32)) ^ _NAME)
    drawn = (to_unit(mix(mix(number) ^ named)).double() * wide * high).long()
    x, y = BLOCK * column + drawn % wide - x0, BLOCK * row + torch.div(drawn, wide, rounding_mode="floor") - y0
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    block = torch.stack((row - first[1], column - first[0]))[:, inside]
    return Pilots(
        (y * width + x)[inside],
        (wide * high)[inside].double(),
        block,
        (rows, columns),
        (x0 - BLOCK * first[0], y0 - BLOCK * first[1]),
    )
