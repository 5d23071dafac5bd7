"""Units of work of a forward engine, and the result of a task.

A *pass* of a render asks an engine for some samples of every pixel of its pixel sets (:data:`SampleRange`). The engine of
kernels cuts them into blocks of pixels (:data:`Block`), one a *task*, which threads take one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torchpt.paths.nonfinite import NonFinite
from torchpt.paths.photons import SentLight
from torchpt.paths.wave import PixelSet, RayCounts

__all__ = ["TASKS", "Block", "SampleRange", "TaskResult"]

#: Tasks of a pass for each thread: enough that no thread waits long for the last task.
TASKS = 6

#: A pixel set, the index of the first sample of each of its pixels, and the number of samples of each.
SampleRange = tuple[PixelSet, int, int]
#: Consecutive pixels of a pixel set: the set, first pixel, number of pixels, first sample and number of samples of each.
Block = tuple[PixelSet, int, int, int, int]


@dataclass
class TaskResult:
    """Result of a task; its samples are in the films already.

    Attributes:
        tally: counts of rays and truncated paths.
        samples: number of camera samples.
        lost: samples that were not finite.
        light: sums of radiance before and after the firefly clamp, from which the summary reports the light that was lost;
            zeros without a clamp.
        unfinished: blocks that ran out of memory, to be rendered again.
        sent: what light paths leave for the camera paths of their sample; None: the task has traced camera paths.
    """

    tally: RayCounts
    samples: int = 0
    lost: NonFinite = field(default_factory=NonFinite)
    light: tuple[float, float] = (0.0, 0.0)
    unfinished: list[Block] = field(default_factory=list)
    sent: SentLight | None = None
