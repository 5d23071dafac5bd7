"""Read and write the JSON files of benchmarks, with the facts about machine and versions."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Return the facts about machine and versions that the figures depend on."""
    versions = {name: importlib.metadata.version(name) for name in ("torch", "mitsuba")}
    return {"cores": os.cpu_count(), "architecture": platform.machine(), **versions}


def write(file: Path, facts: dict[str, Any]) -> None:
    """Write a JSON file atomically: an interrupted write leaves the old file."""
    beside = file.with_name(f"{file.name}.part")
    beside.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
    os.replace(beside, file)


def resumed(file: Path | None, settings: dict[str, Any], again: bool) -> dict[str, Any]:
    """Return the scenes of an earlier run with the same settings and programs; empty without such a run.

    Args:
        file: JSON file of the earlier run.
        settings: settings of this run.
        again: True if a file of another run may be overwritten.

    Raises:
        SystemExit: a file of another benchmark, or of this one with other settings.
    """
    if file is None or not file.exists():
        return {}
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
        before, scenes = facts["settings"] | facts["machine"], facts["scenes"]
    except (ValueError, KeyError, TypeError) as problem:
        if again:
            return {}
        raise SystemExit(
            f"{file}: no figures of this benchmark; name another file, or --again to begin anew"
        ) from problem
    now = settings | machine()
    other = [f"{key} {before.get(key)}, now {now.get(key)}" for key in now if before.get(key) != now[key]]
    if other and again:
        return {}
    if other:
        raise SystemExit(
            f"{file}: measured otherwise ({'; '.join(other)}); name another file, or --again to begin anew"
        )
    return scenes
