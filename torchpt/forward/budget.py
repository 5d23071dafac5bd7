"""What ``render.max_memory`` leaves for waves, and the least that a render works with.

The limit is about the memory of the process above what it held after import. What is there already (scene, search structure,
world) is measured. Films, the picture at the end and code that is still to be loaded are foreseen (``need.py``). What a lane
costs depends on the scene, so it is measured while waves grow.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from torchpt.errors import SceneError
from torchpt.native.memory import Meter, let_go, mb

__all__ = ["Budget", "check_memory", "too_little"]

#: Lanes of the first wave under a limit, after which all code is there: what it adds for good is no lane's.
FEWEST = 4096
#: Of what is free, what waves are let to use: what one piece of the picture costs is measured on another.
SHARE = 0.88
#: Waves grow by no more than this from one to the next.
GROWTH = 2


class Budget:
    """How many lanes fit under a limit, by the memory that those before took.

    Args:
        limit: ``render.max_memory``; None where there is none.
        device: where lanes live.
        most: lanes of a wave where memory is not limited.
        per_lane: bytes that a lane is expected to cost.
    """

    def __init__(self, limit: int | None, device: torch.device, most: int, per_lane: int) -> None:
        self.meter, self.most, self.per_lane = Meter(device), max(most, 1), per_lane
        self.limit = None if limit is None else self.meter.base() + limit
        self._start: int | None = None  # what was held after the first wave
        self._before = 0

    def first(self) -> int:
        """Lanes to begin with."""
        return self.most if self.limit is None else min(FEWEST, self.most)

    def begins(self) -> None:
        """A wave begins."""
        if self.limit is not None:
            self._before = self.meter.peak()

    def ended(self, taken: int, lanes: int) -> int:
        """A wave of ``taken`` lanes ended, of ``lanes`` that might have been; returns how many the next may have."""
        if self.limit is None:
            return lanes
        if self._start is None:
            let_go()
            self._start = self.meter.now()
            return self._fitting(4 * self.per_lane, lanes)
        peak = self.meter.peak()
        rose = peak > self._before
        if not rose and (peak > self.limit or 2 * taken < lanes):
            return lanes  # nothing is known of this wave
        return self._fitting(max(peak - self._start, 1) / taken, lanes, shrinks=rose)

    def _fitting(self, cost: float, lanes: int, shrinks: bool = False) -> int:
        assert self.limit is not None and self._start is not None
        fit = int(SHARE * max(self.limit - self._start, 0) / cost)
        if shrinks and self._before > 0 and self.meter.peak() > self.limit:
            return max(min(fit, lanes), 1)
        return max(lanes, min(fit, GROWTH * lanes if shrinks else max(fit, 1), self.most))

    def halved(self) -> None:
        """An allocation failed: waves do not grow any more."""
        self.limit = None


def check_memory(limit: int, device: torch.device, least: Callable[[int], int], loading: int) -> None:
    """Refuse a limit under which nothing can be rendered.

    Args:
        limit: ``render.max_memory``.
        device: where lanes live.
        least: from what is held above import to the least limit.
        loading: the most that was held above import while the scene was made; 0 where it is not known.

    Raises:
        SceneError: it is too small; says the least that is not.
    """
    let_go()
    meter = Meter(device)
    enough = max(least(max(meter.now() - meter.base(), 0)), loading)
    if limit < enough:
        raise too_little(limit, f"at least {mb(enough)} for this scene and film")


def too_little(limit: int, expected: str) -> SceneError:
    """The error of a limit that is too small; one below a megabyte was hardly meant in bytes."""
    if limit >= 1_000_000:
        return SceneError("render.max_memory", mb(limit), expected)
    return SceneError("render.max_memory", f"{limit} bytes", f"{expected}, as bytes or with a unit such as 4GB")
