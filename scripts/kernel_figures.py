"""Count registers, spills and instructions of the kernels of three scenes as GPU code, for tests and docs.

    python scripts/kernel_figures.py

Writes ``tests/device/kernels.json`` and the table in ``docs/cuda.md``. Needs ``ptxas`` (extra ``cuda-dev``), no GPU, and
some minutes.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import from_tests  # noqa: F401
from ptx_assembler import ARCHITECTURES, assemble, find_ptxas
from ptx_calls import call_backward, call_forward, probed

ROOT = Path(__file__).resolve().parents[1]
TABLE, PAGE = ROOT / "tests" / "device" / "kernels.json", ROOT / "docs" / "cuda.md"
SCENES = ("cornell_box", "veach_mis", "cornell_transmissive")
HEAD = """| scene, pass | kernel | PTX | registers | spills, B | instructions a lane | issues a lane |
|---|---|---:|---:|---:|---:|---:|
"""


def main() -> int:
    """Run the command; return its exit code."""
    ptxas = find_ptxas()
    if ptxas is None:
        print("ptxas is not installed: pip install -e .[cuda-dev]", file=sys.stderr)
        return 1
    found: dict[str, dict[str, dict]] = {}
    for scene in SCENES:
        for which, call in (("forward", call_forward), ("backward", call_backward)):
            found[f"{scene} {which}"] = rows = {}
            for name, probe in probed(scene, call).items():
                figures = {x: assemble(ptxas, probe.ptx, x) for x in ARCHITECTURES}
                rows[name] = {
                    "ptx": sum(probe.machine.instructions.values()),
                    "lanes": probe.lanes,
                    "instructions": round(probe.instructions),
                    "issues": round(probe.issues),
                    "registers": {x: figures[x].registers for x in ARCHITECTURES},
                    "spills": {x: figures[x].spills for x in ARCHITECTURES},
                }
                print(scene, which, name, rows[name], flush=True)
    TABLE.write_text(as_json(found))
    page = PAGE.read_text()
    begin = page.index(HEAD)
    PAGE.write_text(page[:begin] + as_markdown(found) + page[page.index("\n\n", begin) + 1 :])
    return 0


def as_json(found: dict[str, dict[str, dict]]) -> str:
    """Return the figures as JSON, a kernel a line."""
    passes = []
    for name, rows in found.items():
        lines = ",\n".join(f"    {json.dumps(kernel)}: {json.dumps(row)}" for kernel, row in rows.items())
        passes.append(f"  {json.dumps(name)}: {{\n{lines}\n  }}")
    return "{\n" + ",\n".join(passes) + "\n}\n"


def as_markdown(found: dict[str, dict[str, dict]]) -> str:
    """Return the table of the page."""
    lines = [HEAD]
    for name, rows in found.items():
        for kernel, row in rows.items():
            spills = " / ".join(map(str, row["spills"].values())) if any(row["spills"].values()) else "0"
            registers = " / ".join(map(str, row["registers"].values()))
            lines.append(
                f"| {name} | `{kernel}` | {row['ptx']:,} | {registers} | {spills} | {row['instructions']:,} | "
                f"{row['issues']:,} |\n"
            )
    return "".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
