"""Plot the figures of each sweep with their bound."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

from torchpt.core.errors import OutputError
from torchpt.images.write import temporary_beside
from torchpt.stress.case import Outcome

__all__ = ["draw"]

#: Plots side by side, and the width and height of one in inches.
COLUMNS, WIDTH, HEIGHT = 3, 3.4, 2.3
#: Value at which a figure of 0 is drawn, as the axis is logarithmic.
DRAWN_ZERO = 1e-9
#: Sweeps whose largest positive point is more than this many times the least one get a logarithmic axis.
LOG_RATIO = 50


def draw(outcomes: Sequence[Outcome], file: Path) -> bool:
    """Plot all cases with a sweep to ``.svg`` or ``.png``; return False if there are none.

    Raises:
        OutputError: the file cannot be written.
    """
    swept = [outcome for outcome in outcomes if len(outcome.readings) > 2]  # two points make no curve
    if not swept:
        return False
    os.environ.setdefault("MPLBACKEND", "agg")  # needs no display
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 8.0, "svg.hashsalt": "torchpt", "svg.fonttype": "none"}):
        rows = -(-len(swept) // COLUMNS)
        figure = Figure(figsize=(WIDTH * COLUMNS, HEIGHT * rows), layout="constrained")
        FigureCanvasAgg(figure)
        for number, outcome in enumerate(swept):
            axes = figure.add_subplot(rows, COLUMNS, number + 1)
            readings = sorted(outcome.readings, key=lambda one: one.at)
            at, is_log = _axis_positions([one.at for one in readings])
            values = [max(one.figure, DRAWN_ZERO) if math.isfinite(one.figure) else math.nan for one in readings]
            axes.spines[["top", "right"]].set_visible(False)
            axes.plot(at, values, "o-", color="#0072B2", markersize=3, linewidth=1)
            axes.axhline(max(outcome.case.bound, DRAWN_ZERO), color="#D55E00", linestyle="--", linewidth=1)
            # At least up to 1e-3, for plots whose figures are all 0; a factor of 3 keeps points off the frame.
            axes.set_ylim(DRAWN_ZERO / 3, max(*(v for v in values if not math.isnan(v)), outcome.case.bound, 1e-3) * 3)
            axes.set_yscale("log")
            if is_log:
                axes.set_xscale("log")
            axes.set_title(outcome.case.name, loc="left")
            axes.set_xlabel(outcome.case.axis)
        temporary = temporary_beside(file)
        try:
            figure.savefig(
                temporary, metadata={"Date": None} if file.suffix == ".svg" else None
            )  # equal runs, equal files
            os.replace(temporary, file)
        except (OSError, ValueError) as error:
            raise OutputError(file, f"cannot be written ({error})") from None
        finally:
            temporary.unlink(missing_ok=True)
    return True


def _axis_positions(at: list[float]) -> tuple[list[float], bool]:
    """Return positions of the points of a sweep, and True for a logarithmic axis: 0 lies at half of the least other point."""
    positive = [x for x in at if x > 0]
    if not positive or min(at) < 0 or max(positive) <= LOG_RATIO * min(positive):
        return at, False
    return [x or min(positive) / 2 for x in at], True
