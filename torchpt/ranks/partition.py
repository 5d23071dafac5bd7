"""Who takes what: a function of how much there is and how many ranks there are, so that nobody has to ask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from torchpt.core.errors import SceneError
from torchpt.ranks.group import Group

__all__ = ["blocks", "dealt", "share"]

#: Consecutive pixels that stay together: neighbours meet the same things.
TOGETHER = 64
#: Lanes of a block, and blocks a rank takes at least where there are fewer.
LANES, FEWEST = 1 << 16, 4

T = TypeVar("T")


def _mine(count: int, rank: int, size: int) -> range | list[int]:
    """Numbers below ``count`` that a rank takes.

    Round by round each takes one; who begins moves on by one a round, so that nobody has a column of the picture for himself.
    """
    if size == 1:
        return range(count)
    rounds = -(-count // size)
    return [number for k in range(rounds) if (number := k * size + (rank + k) % size) < count]


def dealt(pixels: int, rank: int, size: int) -> Tensor:
    """The pixels of a rank ``(n,)`` int64, ascending, of ``pixels`` that lie row by row.

    Args:
        pixels: how many there are.
        rank: whose.
        size: number of ranks.
    """
    starts = torch.tensor(list(_mine(-(-pixels // TOGETHER), rank, size)), dtype=torch.int64) * TOGETHER
    places = (starts[:, None] + torch.arange(TOGETHER)).reshape(-1)
    return places[places < pixels]


def blocks(count: int, samples: int, group: Group | None) -> list[tuple[int, int]]:
    """Blocks of consecutive pixels (first, how many) that this process takes: all in one where ``group`` is None.

    Args:
        count: of the pixels.
        samples: of each.
        group: the ranks that share them.
    """
    if group is None or group.size == 1:
        return [(0, count)]
    each = max(min(LANES // max(samples, 1), -(-count // (FEWEST * group.size))), 1)
    starts = (each * number for number in _mine(-(-count // each), group.rank, group.size))
    return [(start, min(each, count - start)) for start in starts]


def share(items: Sequence[T], group: Group | None) -> list[tuple[int, T]]:
    """The items of a list that this rank takes, each with its number in the list; all where ``group`` is None.

    Every item is one rank's. The numbers of items that two ranks take differ by one at most.

    Raises:
        SceneError: ``group`` is none.
    """
    if group is None:
        return list(enumerate(items))
    if not hasattr(group, "rank"):
        raise SceneError("group", group, "a torchpt.ranks.Group, or None")
    return [(number, items[number]) for number in _mine(len(items), group.rank, group.size)]
