"""Write a study's report: ``report.html``, ``report.json``, and the plots as PNG and SVG."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchpt.core.version import __version__
from torchpt.reports.analysis import Topic, analyse
from torchpt.reports.page import Figure, page, sheet_of
from torchpt.reports.plots import curves, encoded, overview
from torchpt.reports.runs import Measured, machine, write_whole
from torchpt.reports.study import Study
from torchpt.spec.schema import ParsedParams

__all__ = ["facts_of", "write_report"]


def write_report(study: Study, measured: Sequence[Measured], folder: Path) -> list[Topic]:
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
    topics = [analyse(study, scene) for scene in measured]
    sheets = [sheet_of(topic) for topic in topics]
    figures = [_figures(topic, study.asked["metrics"]) for topic in topics]
    made = time.strftime("%Y-%m-%d %H:%M")
    facts = json.dumps(plain(facts_of(study, topics, made)), indent=1, allow_nan=False)
    where = ", ".join(
        f"{value} {key}" if key in ("cores", "threads") else str(value) for key, value in machine().items()
    )
    text = page(study, topics, sheets, figures, f"torchpt {__version__}, {made}, {where}")
    plots = folder / "plots"
    plots.mkdir(exist_ok=True)
    for topic, found in zip(topics, figures, strict=True):
        for name, (png, svg) in found.items():
            stem = re.sub(r"\W+", "_", Path(topic.name).stem if topic.name.endswith((".yaml", ".yml")) else topic.name)
            write_whole(plots / f"{stem}_{name}.png", png)
            write_whole(plots / f"{stem}_{name}.svg", svg)
    write_whole(folder / "report.json", facts.encode())
    write_whole(folder / "report.html", text.encode())
    return topics


def _figures(topic: Topic, measures: tuple[str, ...]) -> dict[str, Figure]:
    found = {
        "seconds": encoded(curves(topic, measures[0], "seconds")),
        "spp": encoded(curves(topic, measures[0], "spp")),
    }
    if len(measures) > 1:
        found["measures"] = encoded(overview(topic, measures))
    return found


def facts_of(study: Study, topics: Sequence[Topic], made: str) -> dict[str, Any]:
    """Return the content of the report as plain values."""
    asked = {key: value for key, value in study.asked.items() if key not in ("extra", "target")}
    return {
        "torchpt": __version__,
        "made": made,
        "machine": machine(),
        "study": {**asked, "scene": study.scenes},
        "scenes": [
            {
                "scene": topic.name,
                "targets": topic.targets,
                "notes": topic.notes,
                "curves": [line.plain() for line in topic.lines],
            }
            for topic in topics
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
        return value if value == value and abs(value) != float("inf") else None
    return value
