"""Partition pixels and items among ranks: a function of their numbers alone, without communication.

Forward renders deal pixels out (:func:`dealt`), backward passes blocks of them (:func:`blocks`); boundary terms share chunks of
edge samples, and callers their own items (:func:`share`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.ranks.group import Group

__all__ = ["blocks", "dealt", "share"]

#: Consecutive pixels that stay together: neighbours tend to hit the same surfaces.
PIXELS_TOGETHER = 64
#: Lanes of a block, one for each sample of its pixels, and the least number of blocks of a rank.
LANES_PER_BLOCK, FEWEST_BLOCKS = 1 << 16, 4

#: Type of an item.
T = TypeVar("T")


def _indices_of_rank(count: int, rank: int, size: int) -> range | list[int]:
    """Return the indices below ``count`` of a rank, of ``size`` ranks.

    Each round gives an index to every rank; rounds begin with different ranks, so that no rank gets a column of pixels.
    """
    if size == 1:
        return range(count)
    rounds = -(-count // size)  # -(-a // b) is a / b rounded up
    return [number for k in range(rounds) if (number := k * size + (rank + k) % size) < count]


def dealt(pixels: int, rank: int, size: int) -> Tensor:
    """Return the pixels of a rank ``(n,)`` int64, ascending, of a picture in row-major order.

    Args:
        pixels: number of pixels.
        rank: the rank.
        size: number of ranks.
    """
    starts = (
        torch.tensor(list(_indices_of_rank(-(-pixels // PIXELS_TOGETHER), rank, size)), dtype=torch.int64)
        * PIXELS_TOGETHER
    )
    numbers = (starts[:, None] + torch.arange(PIXELS_TOGETHER)).reshape(-1)
    return numbers[numbers < pixels]


def blocks(count: int, samples: int, group: Group | None) -> list[tuple[int, int]]:
    """Return the blocks of consecutive pixels (first, count) of this rank; one block if ``group`` is None.

    Args:
        count: number of pixels.
        samples: samples of each pixel.
        group: the ranks that share the pixels.
    """
    if group is None or group.size == 1:
        return [(0, count)]
    block_pixels = max(min(LANES_PER_BLOCK // max(samples, 1), -(-count // (FEWEST_BLOCKS * group.size))), 1)
    starts = (block_pixels * number for number in _indices_of_rank(-(-count // block_pixels), group.rank, group.size))
    return [(start, min(block_pixels, count - start)) for start in starts]


def share(items: Sequence[T], group: Group | None) -> list[tuple[int, T]]:
    """Return the items of this rank, each with its index; all items if ``group`` is None.

    Every item belongs to one rank. The numbers of items of two ranks differ by at most one.

    Raises:
        SceneError: ``group`` is no group of ranks.
    """
    if group is None:
        return list(enumerate(items))
    if not hasattr(group, "rank"):
        raise SceneError("group", group, "a torchpt.ranks.Group, or None")
    return [(number, items[number]) for number in _indices_of_rank(len(items), group.rank, group.size)]
