"""Show the progress of a render on stderr: samples, rays per second, time left."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

__all__ = ["Bar"]

#: Seconds between two progress lines.
SECONDS_PER_LINE = 10.0


def _format_count(count: float) -> str:
    """Return a number with three digits and a decimal prefix, such as 1.23M."""
    for unit in ("", "k", "M"):
        if count < 1000:
            return f"{count:.3g}{unit}"
        count /= 1000
    return f"{count:.3g}G"


class Bar:
    """A progress bar on stderr, shown only if stderr is a terminal.

    Args:
        name: label of the bar.
        lines: if stderr is not a terminal, print a line every ten seconds instead (for work that takes many minutes).
    """

    def __init__(self, name: str, *, lines: bool = False) -> None:
        self.name, self.lines = name, lines
        self._start = self._last_line_at = time.monotonic()
        self._progress: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Bar:
        """Show the bar."""
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TaskProgressColumn(),
                TextColumn("{task.fields[work]}", markup=False),
                TimeRemainingColumn(),
            )
            self._progress = Progress(*columns, console=Console(stderr=True))
            self._task = self._progress.add_task(self.name, total=None, work="")
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Remove the bar and restore the terminal."""
        if self._progress is not None:
            self._progress.stop()

    def update(self, done: int, total: int, rays: int, seconds: float) -> None:
        """Show the progress: `done` of `total` camera samples, `rays` traced in `seconds`."""
        if self._progress is None or self._task is None:
            now = time.monotonic()
            if self.lines and now - self._last_line_at >= SECONDS_PER_LINE:
                self._last_line_at = now
                percent, elapsed = 100 * done // max(total, 1), now - self._start
                print(
                    f"torchpt: {self.name}: {percent} % of {_format_count(total)} samples after {elapsed:.0f} s",
                    file=sys.stderr,
                )
            return
        rate = rays / seconds if seconds > 0 else 0.0
        work = f"{_format_count(done)}/{_format_count(total)} samples, {_format_count(rate)} rays/s"
        self._progress.update(self._task, completed=done, total=total, work=work)
