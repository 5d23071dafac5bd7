"""Whatever a scene or one of its files holds: a picture, or a line that says what is wrong; in seconds and bounded memory.

The quick form makes a few tries here; the long one thousands in processes of their own, so that one that hangs or dies is told
with its seed. ``python tests/fuzz/tries.py documents SEED 1 FOLDER`` repeats one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import tries

from torchpt.core.threads import warm_up

LONG = {"documents": 10_000, "assets": 4_000}
#: Tries that one process makes.
BATCH = 500


@pytest.mark.parametrize(("family", "count"), [("documents", 15), ("assets", 30)])
def test_damaged_input_is_refused_in_a_line(
    family: str, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    import assets

    warm_up()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tries, "COMPILED", 1 << 60)
    assets.write_sound(tmp_path)
    capfd.readouterr()
    wrong = {}
    for seed in range(1, count + 1):
        found = tries.outcome(lambda seed=seed: tries.FAMILIES[family](seed, tmp_path))
        if "wrong" in found:
            wrong[seed] = found["wrong"]
    assert wrong == {}
    assert [line for line in capfd.readouterr().err.splitlines() if not line.startswith("torchpt: ")] == []


def batch(family: str, first: int, count: int, folder: Path) -> tuple[dict[str, int], dict[int, str]]:
    """Tries in processes of their own: how many came to what, and what went wrong by seed."""
    counts: dict[str, int] = {}
    wrong: dict[int, str] = {}
    end = first + count
    while first < end:
        command = [sys.executable, str(Path(tries.__file__)), family, str(first), str(end - first), str(folder)]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
            "OMP_NUM_THREADS": "1",
        }
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=3600)
        lines: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines()]
        for line in lines:
            if "end" in line:
                word = "wrong" if "wrong" in line else "refused" if line.get("refused") else line["said"].split()[0]
                counts[word] = counts.get(word, 0) + 1
                if "wrong" in line:
                    wrong[line["end"]] = line["wrong"]
        begun = [line["begin"] for line in lines if "begin" in line]
        if not begun:
            raise AssertionError(f"no try was made: {done.stderr[-2000:]}")
        first = begun[-1] + 1
        if lines[-1].get("end") != begun[-1]:
            notes = "".join((folder / name).read_text(errors="replace")[-3000:] for name in ("trace.txt", "crash.txt"))
            wrong[begun[-1]] = f"the process ended with {done.returncode}: {notes}"
            counts["died"] = counts.get("died", 0) + 1
    return counts, wrong


@pytest.mark.long
@pytest.mark.parametrize(
    ("family", "first"), [(family, first) for family, count in LONG.items() for first in range(0, count, BATCH)]
)
def test_thousands_of_damaged_inputs(family: str, first: int, tmp_path: Path) -> None:
    counts, wrong = batch(family, 100_000 + first, BATCH, tmp_path)
    print(family, first, counts)
    assert wrong == {}
    assert sum(counts.values()) == BATCH
