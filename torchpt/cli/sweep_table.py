"""Print the results of the jobs of a sweep as a table. Each job writes its results to a file in the sweep's folder."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchpt.cli.render import Job

__all__ = ["error_of", "print_jobs", "record_job", "two_digits"]

_HEADING = ("job", "overrides", "out", "error", "seconds")


def record_job(job: Job, facts: Mapping[str, Any]) -> None:
    """Write the results of a job to the sweep's folder; do nothing outside a sweep or if the folder cannot be reached.

    Args:
        job: the job.
        facts: its summary.
    """
    if job.folder is not None:
        results = {
            name: facts[name]
            for name in ("out", "relmse", "relmse_interval", "heavy_tailed", "seconds")
            if name in facts
        }
        results |= {"job": job.number, "overrides": list(job.words)}
        with suppress(OSError):  # the job may run on another machine
            (Path(job.folder) / f"torchpt-job-{job.number}.json").write_text(json.dumps(results))


def print_jobs(folder: str) -> None:
    """Print the table of a sweep on stderr, if at least two jobs wrote results."""
    found = [json.loads(path.read_text()) for path in Path(folder).glob("torchpt-job-*.json")]
    if len(found) > 1:
        print("\n".join(table(found)), file=sys.stderr)


def table(jobs: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a table of jobs; overrides that all jobs share are left out."""
    jobs = sorted(jobs, key=lambda job: job["job"])
    common = set.intersection(*(set(job["overrides"]) for job in jobs))
    rows: list[tuple[str, ...]] = [_HEADING]
    for job in jobs:
        words = " ".join(word for word in job["overrides"] if word not in common)
        out = job.get("out", "")
        names = out if isinstance(out, str) else ", ".join(out)
        rows.append((str(job["job"]), words, names, error_of(job) or "-", two_digits(job.get("seconds", math.nan))))
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADING))]
    return ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def error_of(facts: Mapping[str, Any]) -> str:
    """Return the relative error of a summary as text, or an empty string if it is not known."""
    if facts.get("relmse") is None:
        return ""
    text = f"{_percent(facts['relmse'])} %"
    if facts.get("relmse_interval") is not None:
        low, high = map(_percent, facts["relmse_interval"])
        text += f" ({low} to {high} %)"
    return text + (", most of it in few pixels" if facts.get("heavy_tailed") else "")


def _percent(relmse: float) -> str:
    """Return the relative error in percent, the root of relMSE."""
    return two_digits(100.0 * math.sqrt(max(relmse, 0.0)))


def two_digits(value: float) -> str:
    """Format a number to two significant digits, or as a whole number from 10 on."""
    return f"{value:.0f}" if value >= 10.0 else f"{value:.2g}"
