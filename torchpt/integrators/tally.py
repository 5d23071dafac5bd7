"""What waves did, counted: of one render, or of each of several that share a wave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = ["Tallies", "Tally"]


@dataclass
class Tally:
    """What a wave did.

    Attributes:
        rays: that were searched for, those of shadows too.
        truncated: paths that were still alive at :data:`torchpt.integrators.path.ENDLESS`.
    """

    rays: int = 0
    truncated: int = 0

    def searched(self, lanes: Tensor) -> None:
        """A ray of each of these lanes ``(n,)``."""
        self.rays += len(lanes)

    def cut(self, lanes: Tensor) -> None:
        """The paths of these lanes ``(n,)`` were ended."""
        self.truncated += len(lanes)


class Tallies(Tally):
    """The same, and of each of several renders besides.

    Args:
        sizes: how many lanes of the wave each of them has; they follow each other.
        device: where the lanes live.
    """

    def __init__(self, sizes: Sequence[int], device: torch.device) -> None:
        super().__init__()
        self._ends = torch.tensor(sizes, device=device).cumsum(0)
        self._counts = torch.zeros(2, len(sizes), dtype=torch.int64, device=device)

    def searched(self, lanes: Tensor) -> None:
        """See :class:`Tally`."""
        super().searched(lanes)
        self._count(0, lanes)

    def cut(self, lanes: Tensor) -> None:
        """See :class:`Tally`."""
        super().cut(lanes)
        self._count(1, lanes)

    def _count(self, row: int, lanes: Tensor) -> None:
        owner = torch.searchsorted(self._ends, lanes, right=True)
        self._counts[row].scatter_add_(0, owner, torch.ones_like(owner))

    def each(self) -> list[Tally]:
        """Of each render."""
        return [Tally(rays, truncated) for rays, truncated in self._counts.T.tolist()]
