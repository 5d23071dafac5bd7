"""Plot the curves of ``bench_mitsuba.py --error``: a panel for each scene, error against time, both logarithmic."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from bench_workers import LLVM, OURS

ACROSS = 5
#: Colour and marker of each contender.
LOOKS = {
    OURS: ("#d1495b", "o"),
    f"{LLVM} independent": ("#8d99ae", "s"),
    f"{LLVM} multijitter": ("#2b4c7e", "^"),
}


def plot(found: dict[str, Any], budgets: list[float], file: Path) -> None:
    """Draw the scenes of a contest.

    Args:
        found: results of ``bench_error.measured`` by scene.
        budgets: times in seconds, marked by lines.
        file: path with an extension that matplotlib can write, such as ``.svg`` or ``.png``.

    Raises:
        SystemExit: no scenes, or a file that cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not found:
        raise SystemExit(f"{file}: no scenes to draw")
    columns = min(ACROSS, len(found))
    rows = math.ceil(len(found) / columns)
    figure = Figure(figsize=(2.5 * columns, 2.3 * rows + 0.5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel, (name, row) in zip(panels, found.items(), strict=False):
        for who, points in row["curves"].items():
            colour, marker = LOOKS[who]
            x, y = ([point[key] for point in points] for key in ("seconds", "relmse"))
            panel.loglog(x, y, color=colour, marker=marker, markersize=3.5, linewidth=1.2, label=who)
        for budget in budgets:
            panel.axvline(budget, color="#00000022", linewidth=0.8, zorder=0)
        panel.set_xticks(budgets, [f"{budget:g}" for budget in budgets])
        panel.tick_params(labelsize=7)
        panel.minorticks_off()
        panel.set_title(name, fontsize=9)
    for panel in panels[len(found) :]:
        panel.set_axis_off()
    figure.supxlabel("seconds a picture", fontsize=9)
    figure.supylabel("relMSE", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(LOOKS), fontsize=8)
    beside = file.with_name(f"{file.stem}.part{file.suffix}")
    try:
        canvas.print_figure(beside, dpi=110)
        os.replace(beside, file)
    except (OSError, ValueError) as problem:
        beside.unlink(missing_ok=True)
        raise SystemExit(f"{file}: {problem}") from problem
