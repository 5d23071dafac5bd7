"""What waves did, counted: of one render, or of each of several that share a wave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchpt.math.vectors import take

__all__ = ["Tallies", "Tally"]


@dataclass
class Tally:
    """What waves did.

    Attributes:
        rays: that were searched for, those of shadows too.
        truncated: paths that were still alive at :data:`torchpt.integrators.path.ENDLESS`.
    """

    rays: int = 0
    truncated: int = 0

    def searched(self, lanes: Tensor, index: Tensor | None = None) -> None:
        """A ray of each of the lanes ``(n,)``, or of those at ``index`` among them."""
        self.rays += len(lanes if index is None else index)

    def cut(self, lanes: Tensor, index: Tensor) -> None:
        """The paths of the lanes at ``index`` were ended."""
        self.truncated += len(index)

    def each(self) -> list[Tally]:
        """Of each render that shares the wave: of the only one."""
        return [self]


class Tallies(Tally):
    """What a wave did for each of several renders.

    Args:
        sizes: how many of its lanes each of them has; they follow each other.
        device: where the lanes live.
    """

    def __init__(self, sizes: Sequence[int], device: torch.device) -> None:
        super().__init__()
        self._ends = torch.tensor(sizes, device=device).cumsum(0)
        self._counts = torch.zeros(2, len(sizes), dtype=torch.int64, device=device)

    def searched(self, lanes: Tensor, index: Tensor | None = None) -> None:
        """See :class:`Tally`."""
        self._count(0, take(lanes, index))

    def cut(self, lanes: Tensor, index: Tensor) -> None:
        """See :class:`Tally`."""
        self._count(1, take(lanes, index))

    def _count(self, row: int, lanes: Tensor) -> None:
        owner = torch.searchsorted(self._ends, lanes, right=True)
        self._counts[row].scatter_add_(0, owner, torch.ones_like(owner))

    def each(self) -> list[Tally]:
        """Of each render."""
        return [Tally(rays, truncated) for rays, truncated in self._counts.T.tolist()]
