"""Write a study's report: ``report.html``, ``report.json``, and the plots as PNG and SVG."""

from __future__ import annotations

import itertools
import json
import math
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchpt.core.version import __version__
from torchpt.reports.analysis import SceneReport, analyse
from torchpt.reports.page import Figure, image_strip_of, page
from torchpt.reports.plots import curves, encoded, overview
from torchpt.reports.runs import Measured, machine, write_whole
from torchpt.reports.study import Study
from torchpt.spec.schema import ParsedParams

__all__ = ["facts_of", "plot_stems", "write_report"]


def write_report(study: Study, measured: Sequence[Measured], folder: Path) -> list[SceneReport]:
    """Analyse the runs of a study and write its report.

    Args:
        study: the study.
        measured: its scenes, with all runs.
        folder: an existing folder.

    Returns:
        The analysed scenes.

    Raises:
        OutputError: a file cannot be written.
    """
    scene_reports = [analyse(study, scene) for scene in measured]
    sheets = [image_strip_of(scene_report) for scene_report in scene_reports]
    figures = [_figures(scene_report, study.options["metrics"]) for scene_report in scene_reports]
    made = time.strftime("%Y-%m-%d %H:%M")
    facts = json.dumps(plain(facts_of(study, scene_reports, made)), indent=1, allow_nan=False)
    # Such as "AMD EPYC, 8 cores, 4 threads".
    where = ", ".join(
        f"{value} {key}" if key in ("cores", "threads") else str(value) for key, value in machine().items()
    )
    text = page(study, scene_reports, sheets, figures, f"torchpt {__version__}, {made}, {where}")
    plots = folder / "plots"
    plots.mkdir(exist_ok=True)
    stems = plot_stems([scene_report.name for scene_report in scene_reports])
    for stem, found in zip(stems, figures, strict=True):
        for name, (png, svg) in found.items():
            write_whole(plots / f"{stem}_{name}.png", png)
            write_whole(plots / f"{stem}_{name}.svg", svg)
    write_whole(folder / "report.json", facts.encode())
    write_whole(folder / "report.html", text.encode())
    return scene_reports


def plot_stems(scenes: Sequence[str]) -> list[str]:
    """Return the beginnings of the names of plot files, distinct for each scene (a name or a scene file)."""
    stems: list[str] = []
    for scene in scenes:
        is_path = scene.endswith((".yaml", ".yml", ".xml"))
        # Everything that is no letter, digit or underscore becomes an underscore.
        base = re.sub(r"\W+", "_", Path(scene).stem if is_path else scene)
        candidates = (base if number == 1 else f"{base}_{number}" for number in itertools.count(1))
        stems.append(next(stem for stem in candidates if stem not in stems))
    return stems


def _figures(scene_report: SceneReport, measures: tuple[str, ...]) -> dict[str, Figure]:
    """Return the figures of a scene by name: the first measure over seconds and over samples, and all measures."""
    found = {
        "seconds": encoded(curves(scene_report, measures[0], "seconds")),
        "spp": encoded(curves(scene_report, measures[0], "spp")),
    }
    if len(measures) > 1:
        found["measures"] = encoded(overview(scene_report, measures))
    return found


def facts_of(study: Study, scene_reports: Sequence[SceneReport], made: str) -> dict[str, Any]:
    """Return the content of the report as plain values."""
    # Other renderers' pictures (`extra`) are among the curves below, and the targets in use beside them.
    options = {key: value for key, value in study.options.items() if key not in ("extra", "target")}
    return {
        "torchpt": __version__,
        "made": made,
        "machine": machine(),
        "study": {**options, "scene": study.scenes},
        "scenes": [
            {
                "scene": scene_report.name,
                "targets": scene_report.targets,
                "notes": scene_report.notes,
                "curves": [line.plain() for line in scene_report.lines],
            }
            for scene_report in scene_reports
        ],
    }


def plain(value: Any) -> Any:
    """Return a value ready for JSON; non-finite numbers become null."""
    if isinstance(value, ParsedParams):
        return plain({"type": value.name, **value.values})
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
