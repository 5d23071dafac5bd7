"""What is asked of an engine that takes samples, and what a part of that came to."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.wave import PixelSet, RayCounts

__all__ = ["TASKS", "Block", "Span", "TaskResult"]

#: Tasks of a pass for each thread, so that none waits long for the last one.
TASKS = 6

#: A plate, the first sample of all its pixels, and how many.
Span = tuple[PixelSet, int, int]
#: A plate, its first pixel and how many, the first sample and how many of each.
Block = tuple[PixelSet, int, int, int, int]


@dataclass
class TaskResult:
    """Results of a task beside its samples.

    Attributes:
        tally: rays and paths.
        samples: camera samples taken.
        lost: samples that were not finite.
        light: before and after the clamp.
        rest: what memory did not suffice for.
    """

    tally: RayCounts
    samples: int = 0
    lost: NonFinite = field(default_factory=NonFinite)
    light: tuple[float, float] = (0.0, 0.0)
    rest: list[Block] = field(default_factory=list)
