"""Plot error over seconds and over samples, with 95 % bands, as PNG and SVG.

Colours are those of Okabe and Ito (2008), which colour-blind readers can distinguish; markers and dashes differ too, for
prints in grey.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from io import BytesIO
from typing import Any

from torchpt.reports.analysis import ErrorCurve, SceneReport
from torchpt.reports.study import ERRORS

__all__ = ["COLOURS", "NAMES", "curves", "encoded", "overview"]

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D1F")
#: Matplotlib's markers and dashes.
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
_DASHES = ("-", "--", "-.", (0, (5, 1, 1, 1, 1, 1)))
#: Dashes of denoised curves, which have hollow markers and the colour of the curve that was denoised.
_DENOISED = (0, (4, 4))
#: Names of measures in the report, by their keys in studies.
NAMES = {
    "relmse": "relMSE",
    "relmse_trimmed": "relMSE, 0.1 % trimmed",
    "mse": "MSE",
    "smape": "SMAPE",
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "flip": "HDR-FLIP",
}
_STYLE: dict[str, Any] = {
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#d8d8d8",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "svg.hashsalt": "torchpt",  # the same figures, the same file
    "svg.fonttype": "path",
}


def _matplotlib() -> Any:
    """Import matplotlib without a window."""
    os.environ.setdefault("MPLBACKEND", "agg")
    import matplotlib

    return matplotlib


def curves(scene_report: SceneReport, measure: str, over: str) -> Any:
    """Return the figure of a measure with all curves that have it.

    Args:
        scene_report: the curves of a scene.
        measure: a key of :data:`NAMES`.
        over: the x axis, ``seconds`` or ``spp``; curves with a step of unknown samples have no ``spp``.
    """
    matplotlib = _matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        lines = [line for line in scene_report.lines if over == "seconds" or all(step.spp for step in line.steps)]
        rows = len(lines) + (1 if over == "spp" else 0)
        # Inches: the axes, and a row of the legend for each curve.
        figure = Figure(figsize=(4.9, 3.4 + 0.23 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        for line in scene_report.lines:
            if line in lines:
                _draw(axes, line, measure, over, slopes=True)
        if over == "spp":
            _guide(axes, lines, measure)
        _finish(axes, measure, over)
        if over == "spp":
            steps = sorted({step.spp for line in lines for step in line.steps if step.spp})
            if len(steps) <= 8:
                axes.set_xticks(steps, labels=[f"{n:,}".replace(",", " ") for n in steps])
                axes.minorticks_off()
        axes.set_title(f"{NAMES[measure]} over {'seconds' if over == 'seconds' else 'samples a pixel'}", loc="left")
        figure.legend(loc="outside lower left", fontsize=10.0)
    return figure


def overview(scene_report: SceneReport, measures: Sequence[str]) -> Any:
    """Return a figure of all measures over seconds, in small plots with one legend."""
    matplotlib = _matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        rows = -(-len(measures) // 2)
        # Inches, as in `curves`.
        figure = Figure(figsize=(7.2, 2.3 * rows + 0.21 * len(scene_report.lines)), layout="constrained")
        FigureCanvasAgg(figure)
        for number, measure in enumerate(measures):
            axes = figure.add_subplot(rows, 2, number + 1)
            for line in scene_report.lines:
                # The curves enter the common legend once, with the first plot.
                _draw(axes, line, measure, "seconds", slopes=False if number == 0 else None)
            _finish(axes, measure, "seconds")
            axes.set_title(NAMES[measure], loc="left", fontsize=10.0)
            axes.set_ylabel("")
        figure.legend(loc="outside lower left", fontsize=10.0)
    return figure


def encoded(figure: Any) -> tuple[bytes, bytes]:
    """Return a figure as PNG and as SVG."""
    matplotlib = _matplotlib()
    png, svg = BytesIO(), BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(png, format="png", dpi=200)
        figure.set_layout_engine("none")  # keep the layout of the PNG
        figure.savefig(svg, format="svg", metadata={"Date": None})
    return png.getvalue(), svg.getvalue()


def _points(line: ErrorCurve, measure: str, over: str) -> list[tuple[float, float, float, float]]:
    """Return x, mean, lower and upper bound of each step that can be drawn: finite, and positive where the axis is logarithmic.

    The bounds are those of the 95 % confidence interval, or the mean where a step has none.
    """
    points = []
    for step in line.steps:
        found, x = step.estimate(measure), step.seconds if over == "seconds" else step.spp
        if x and math.isfinite(found.mean) and (found.mean > 0 or measure not in ERRORS):
            low = found.mean if found.low is None else found.low
            points.append((float(x), found.mean, low, found.mean if found.high is None else found.high))
    return points


def _draw(axes: Any, line: ErrorCurve, measure: str, over: str, *, slopes: bool | None) -> None:
    """Draw one curve with its band.

    Args:
        axes: axes of the plot.
        line: the curve.
        measure: a key of :data:`NAMES`.
        over: ``seconds`` or ``spp``.
        slopes: its entry in the legend: True: name and slope; False: the name; None: no entry.
    """
    style_index, inside = line.style_index, "auto" if line.denoised_from is None else "white"
    # The dashes change with each curve and once more with each round of colours, so colour and dashes do not repeat together.
    colour, mark = COLOURS[style_index % len(COLOURS)], _MARKS[style_index % len(_MARKS)]
    dash_index = (style_index // len(COLOURS) + style_index) % len(_DASHES)
    dash: Any = _DASHES[dash_index] if line.measured else ":"  # dotted: another renderer's pictures
    dash = dash if line.denoised_from is None else _DENOISED
    points = _points(line, measure, over)
    if not points:
        return
    x, mean, low, high = (list(values) for values in zip(*points, strict=True))
    label = None if slopes is None else line.label + (_slope(line, over) if slopes else "")
    style = {"color": colour, "linestyle": dash, "linewidth": 1.6}
    axes.plot(x, mean, marker=mark, markersize=5, markerfacecolor=inside, label=label, **style)
    if x == sorted(x):
        axes.fill_between(x, low, high, color=colour, alpha=0.16, linewidth=0)
    else:  # runs so short that more samples took less time
        axes.vlines(x, low, high, color=colour, alpha=0.5)
    # The least error that more samples can reach, where the bias test found a bias.
    floor = line.floor if measure == "relmse" else 0.0
    if floor > 0:
        axes.axhline(floor, color=colour, linewidth=1.0, linestyle=(0, (1, 2)))
        if not axes.texts:  # label it once
            place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom"}
            axes.annotate("bias", (1.0, floor), fontsize=9, color=colour, **place)


def _slope(line: ErrorCurve, over: str) -> str:
    """Return the slope of a curve for the legend, with a minus sign; an empty text without a confidence interval."""
    found = line.by_seconds if over == "seconds" else line.by_spp
    return "" if found is None or found.slope.low is None else f"   slope {found.slope.mean:.2f}".replace("-", "−")


def _guide(axes: Any, lines: Sequence[ErrorCurve], measure: str) -> None:
    """Draw the error ``1 / samples`` of an unbiased estimator, from the worst curve's first point; squared errors only."""
    points = [point for line in lines if line.denoised_from is None for point in _points(line, measure, "spp")]
    if measure not in ("relmse", "mse", "relmse_trimmed") or not points:
        return
    left, right = min(x for x, *_ in points), max(x for x, *_ in points)
    top = max(mean for x, mean, *_ in points if x == left)
    axes.plot(
        [left, right],
        [top, top * left / right],
        color="#777777",
        linewidth=0.9,
        linestyle=":",
        label="1 / samples",
        zorder=1,
    )


def _finish(axes: Any, measure: str, over: str) -> None:
    """Set scales, ticks, grid and the label of the x axis; errors have a logarithmic y axis, PSNR and SSIM a linear one."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    if measure in ERRORS:
        axes.set_yscale("log")
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    low, high = axes.get_xlim()
    if high / low < 20:  # little more than a decade: powers of ten alone would be one or two ticks
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(plain)
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = axes.get_ylim()
    if measure in ERRORS:
        if high / low < 30:
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(plain)
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major")
    axes.set_axisbelow(True)
    axes.set_xlabel("seconds, without set-up" if over == "seconds" else "samples a pixel")
