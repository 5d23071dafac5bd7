"""How many lanes a wave has where memory is short: fewer after a failed allocation, as many as fit under a limit."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from functools import cache

from torchpt.errors import RenderError
from torchpt.forward.budget import Budget
from torchpt.forward.schedule import Span
from torchpt.native.memory import let_go
from torchpt.shortage import ran_out

__all__ = ["Waves", "say_once"]


@cache
def say_once(text: str) -> None:
    """A line on stderr, the first time only."""
    print(text, file=sys.stderr, flush=True)


class Waves:
    """Pieces of passes, as large as memory lets them be.

    Args:
        budget: what a wave may hold.
        what: of which there is too little memory where not even one lane fits.

    Attributes:
        lanes: most of the next piece.
        halved: whether an allocation failed.
    """

    def __init__(self, budget: Budget, what: str = "a wave of a single lane") -> None:
        self.budget, self.lanes, self.what = budget, budget.first(), what
        self.halved = False

    def through(self, work: Callable[[Span], None], pixels: int, first: int, count: int) -> Iterator[Span]:
        """Samples ``first .. first + count`` of all pixels, piece by piece; yields each once it is done.

        Pieces split pixels, and samples of one pixel stay in their order, so that sums do not depend on the pieces.

        Args:
            work: takes a piece: all of it, or, where it raises, nothing.
            pixels: how many.
            first: sample.
            count: samples of each.

        Raises:
            RenderError: not even a single lane fits in memory.
        """
        sample = first
        while sample < first + count:
            samples = max(min(first + count - sample, self.lanes), 1)
            pixel = 0
            while pixel < pixels:
                n = min(max(self.lanes // samples, 1), pixels - pixel)
                yield from self._whole(work, (pixel, n, sample, samples))
                pixel += n
            sample += samples

    def _whole(self, work: Callable[[Span], None], span: Span) -> Iterator[Span]:
        """A piece at once, or in halves."""
        pixel, n, sample, samples = span
        if n * samples <= self.lanes:
            self.budget.begins()
            if self._done(work, span):
                self.lanes = self.budget.ended(n * samples, self.lanes)
                yield span
                return
            self._halve(n * samples)
        if n > 1:
            half = n // 2
            parts = (pixel, half, sample, samples), (pixel + half, n - half, sample, samples)
        else:
            half = samples // 2
            parts = (pixel, n, sample, half), (pixel, n, sample + half, samples - half)
        for part in parts:
            yield from self._whole(work, part)

    @staticmethod
    def _done(work: Callable[[Span], None], span: Span) -> bool:
        """Whether there was memory enough; what the piece held is free only once its error is, so no error is handed on."""
        try:
            work(span)
        except Exception as error:
            if not ran_out(error):
                raise
            return False
        return True

    def _halve(self, tried: int) -> None:
        let_go()
        if tried <= 1:
            raise RenderError(f"not enough memory for {self.what}")
        self.lanes, self.halved = max(tried // 2, 1), True
        self.budget.halved()
        say_once("torchpt: memory ran out: waves of fewer lanes from now on, for the same picture")
