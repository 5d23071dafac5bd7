"""When a render ends, and how many samples it takes until it asks again.

Where only ``render.spp`` ends it, passes double if somebody looks at the picture in between. Else they are blocks of 16
samples, after a start that doubles, and shorter where a block would take more time than is left, or is more than a quarter of
the samples there are: every pass begins at a multiple of its own length, so that sequences stay balanced.

An error is asked for at four numbers of samples an octave, from 16 on: each time it may lie below the target by chance.
A pass before a time limit is let to take twice as long as the last ones foretell, as other work on the machine may slow it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torchpt.scene.settings import Render

__all__ = ["BLOCK", "StopRules"]

#: A pass never holds more samples a pixel than this.
LARGEST_PASS = 64
#: Where something else than the number of samples may end a render, passes hold no more than this.
BLOCK = 16
#: What of ``render.time_limit`` may be left over or exceeded.
SLACK = 0.03
#: Samples from which on an error may end a render: of fewer it is little more than a guess.
FEWEST = 16
#: How many times longer than foretold a pass may take for the time limit to hold; of a single sample, which cannot be cut.
SLOWER, SLOWER_ONE = 2.0, 1.25
#: What is left of the difference to a quicker pass, from one pass to the next.
FADING = 0.75


@dataclass
class StopRules:
    """The rules of one render.

    Attributes:
        render: the settings.
        streams: that share the samples of a pixel.
        longest: seconds that a pass may take where only ``render.spp`` ends it; None: it does not matter.
        watched: whether something looks at the picture between passes; else they are as long as they may be.
        after: what comes after the last sample, as a share of the samples there are: pixels that are looked at again.
        reason: the rule that ended it; "" as long as it goes on.
        share: of the work that is done, 0..1, by the rule that is nearest to its end.
    """

    render: Render
    streams: int = 1
    longest: float | None = None
    watched: bool = True
    after: float = 0.0
    reason: str = ""
    share: float = 0.0
    _pace: float | None = field(default=None, repr=False)  # seconds a sample of every pixel, in the last passes
    _last: tuple[float, float] = field(default=(0.0, 0.0), repr=False)

    @property
    def open(self) -> bool:
        """Whether something else than the number of samples may end it."""
        return bool(self.render.stops)

    def checks_error(self, taken: float, adaptive: bool = False) -> bool:
        """Whether an error may end the render at so many samples a pixel; adaptive rounds are few, so each may."""
        if self.render.target_error is None or taken < FEWEST:
            return False
        whole = int(taken)
        return adaptive or (whole == taken and whole % (1 << max(whole.bit_length() - 3, 0)) == 0)

    def told(self, taken: float, seconds: float, error: float | None) -> None:
        """What was reached after a pass: samples a pixel, seconds of sampling, and relMSE where it is asked for.

        An ``error`` at or below the target ends the render: who tells it must be certain of it.
        """
        before, since = self._last
        if taken > before and seconds > since:
            pace = (seconds - since) / (taken - before)
            self._pace = pace if self._pace is None else max(pace, FADING * self._pace + (1.0 - FADING) * pace)
        self._last = taken, seconds
        done = {"spp": taken / self.render.spp}
        if self.render.time_limit is not None:
            done["time_limit"] = 1.0 - self.time_left() / self.render.time_limit
        if self.render.target_error is not None and error is not None:
            done["target_error"] = self.render.target_error / error if error > 0.0 else 1.0
        self.share = min(max(done.values()), 1.0)
        for rule, share in done.items():
            near = 1.0 - SLACK if rule == "time_limit" else 1.0
            if share >= near and not self.reason:
                self.reason = rule

    def step(self, taken: int) -> int:
        """Samples of the next pass; 0 where it is to end."""
        left = self.render.spp - taken
        if self.reason or left <= 0:
            self.reason = self.reason or "spp"
            return 0
        if not self.open:
            size = max(taken, self.streams) if self.watched else LARGEST_PASS
            while self.longest is not None and self._pace is not None and size > 1 and self._pace * size > self.longest:
                size //= 2
            return min(size, LARGEST_PASS, left)
        if taken == 0:
            return min(self.streams, left)
        # The lowest bit that is set: what a pass of that length begins at a multiple of.
        size = min(BLOCK, taken & -taken)
        if self.render.target_error is not None and taken >= BLOCK:
            while size > max(taken // 4, 1):
                size //= 2
        if self.render.time_limit is not None and self._pace is not None:
            seconds = self.time_left() + SLACK * self.render.time_limit
            while size > 1 and SLOWER * self._pace * size > seconds:
                size //= 2
            if SLOWER_ONE * self._pace * size > seconds:
                self.reason = "time_limit"
                return 0
        return min(size, left)

    def should_continue(self, mean: float) -> bool:
        """Whether adaptive sampling goes on, at so many samples a pixel."""
        if not self.reason and mean >= self.render.spp:
            self.reason = "spp"
        if not self.reason and self.affordable(1.0) < 1.0:
            self.reason = "time_limit"
        return not self.reason

    def time_left(self) -> float:
        """Seconds that ``render.time_limit`` leaves, but for what comes after the last sample."""
        if self.render.time_limit is None:
            return float("inf")
        taken, seconds = self._last
        return self.render.time_limit - seconds - self.after * taken * (self._pace or 0.0)

    def affordable(self, more: float) -> float:
        """Of ``more`` samples a pixel those for which there is time."""
        if self._pace is None or self._pace <= 0.0:
            return more
        return min(more, max(self.time_left(), 0.0) / (SLOWER * self._pace))
