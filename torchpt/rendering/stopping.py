"""Stop rules of a render, and the number of samples of its next pass.

Where only ``render.spp`` ends the render, the length of passes doubles if something looks at the picture in between. Otherwise
it doubles up to 16 samples a pixel, and is shorter where a pass would take more time than is left, or (with a target error)
more than a quarter of the samples so far. Every pass begins at a multiple of its length, so that sequences stay balanced.
:class:`~torchpt.rendering.run.Run` asks for the length of each pass in turn.

The error is checked at four numbers of samples an octave, from 16 on: each check may pass by chance. A pass may take twice
as long as predicted before it breaks a time limit, as other work on the machine may slow it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from torchpt.scene.settings import Render

__all__ = ["BLOCK", "StopRules"]

#: Largest number of samples a pixel of a pass.
LARGEST_PASS = 64
#: Largest number of samples a pixel of a pass where anything besides ``spp`` may end the render.
BLOCK = 16
#: Tolerance of ``render.time_limit``, as a share of it.
SLACK = 0.03
#: Fewest samples a pixel at which a target error may end a render; the estimate of fewer is a guess.
FEWEST_FOR_ERROR = 16
#: Factors on the predicted time of a pass, so that the time limit holds; the second for a pass of one sample.
SLOWER, SLOWER_ONE = 2.0, 1.25
#: Weight of the earlier seconds for a sample, where the last pass was quicker; a slower last pass counts at once.
KEPT_PACE = 0.75


@dataclass
class StopRules:
    """The stop rules of one render, and its progress toward them.

    Attributes:
        render: settings of the render.
        randomizations: number of randomizations that share the samples of a pixel.
        longest_pass_seconds: longest pass in seconds where only ``render.spp`` ends the render; None: unbounded.
        picture_is_watched: False if nothing looks at the picture between passes, which are as long as possible then.
        resampling_share: samples of resampled outliers at the end, as a share of all samples.
        reason: the rule that ended the render; "" while it goes on.
        progress: fraction of the work that is done, 0..1, by the rule closest to its end.
    """

    render: Render
    randomizations: int = 1
    longest_pass_seconds: float | None = None
    picture_is_watched: bool = True
    resampling_share: float = 0.0
    reason: str = ""
    progress: float = 0.0
    _pace: float | None = field(default=None, repr=False)  # seconds for one sample of every pixel, by the last passes
    _last_update: tuple[float, float] = field(default=(0.0, 0.0), repr=False)  # samples a pixel and seconds

    @property
    def has_other_rules(self) -> bool:
        """True if anything besides ``spp`` may end the render."""
        return bool(self.render.stops)

    def checks_error(self, taken: float, *, adaptive: bool = False) -> bool:
        """Return True if the target error is checked at ``taken`` samples a pixel; adaptive rounds are few: always."""
        if self.render.target_error is None or taken < FEWEST_FOR_ERROR:
            return False
        whole = int(taken)
        # Four checks an octave: below its three highest bits the number is 0.
        return adaptive or (whole == taken and whole % (1 << max(whole.bit_length() - 3, 0)) == 0)

    def update(self, taken: float, seconds: float, error: float | None) -> None:
        """Update the rules after a pass with samples a pixel, seconds of sampling, and relMSE (None: not checked).

        An ``error`` at or below the target ends the render, so it should be an upper bound.
        """
        taken_before, seconds_before = self._last_update
        if taken > taken_before and seconds > seconds_before:
            pace = (seconds - seconds_before) / (taken - taken_before)
            self._pace = pace if self._pace is None else max(pace, KEPT_PACE * self._pace + (1.0 - KEPT_PACE) * pace)
        self._last_update = taken, seconds
        done = {"spp": taken / self.render.spp}  # rule -> fraction of the work that it sees as done
        if self.render.time_limit is not None:
            done["time_limit"] = 1.0 - self.time_left() / self.render.time_limit
        if self.render.target_error is not None and error is not None:
            done["target_error"] = self.render.target_error / error if error > 0.0 else 1.0
        self.progress = min(max(done.values()), 1.0)
        for rule, share in done.items():
            reached = 1.0 - SLACK if rule == "time_limit" else 1.0
            if share >= reached and not self.reason:
                self.reason = rule

    def next_pass_spp(self, taken: int) -> int:
        """Return the samples a pixel of the next pass; 0 if the render is to end."""
        left = self.render.spp - taken
        if self.reason or left <= 0:
            self.reason = self.reason or "spp"
            return 0
        if not self.has_other_rules:
            size = max(taken, self.randomizations) if self.picture_is_watched else LARGEST_PASS
            while (
                self.longest_pass_seconds is not None
                and self._pace is not None
                and size > 1
                and self._pace * size > self.longest_pass_seconds
            ):
                size //= 2
            return min(size, LARGEST_PASS, left)
        if taken == 0:
            return min(self.randomizations, left)
        # A pass begins at a multiple of its length: that is at most the lowest bit set in `taken`.
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
        """Return True if adaptive sampling goes on at a mean of ``mean`` samples a pixel."""
        if not self.reason and mean >= self.render.spp:
            self.reason = "spp"
        if not self.reason and self.affordable_spp(1.0) < 1.0:
            self.reason = "time_limit"
        return not self.reason

    def time_left(self) -> float:
        """Return the seconds that ``render.time_limit`` leaves for sampling, without resampling outliers."""
        if self.render.time_limit is None:
            return float("inf")
        taken, seconds = self._last_update
        return self.render.time_limit - seconds - self.resampling_share * taken * (self._pace or 0.0)

    def affordable_spp(self, more: float) -> float:
        """Return the number of samples a pixel, at most ``more``, for which there is time."""
        if self._pace is None or self._pace <= 0.0:
            return more
        return min(more, max(self.time_left(), 0.0) / (SLOWER * self._pace))
