"""Machine code of PTX by NVIDIA's ``ptxas``, where it is installed (extra ``cuda-dev``): registers and spills of kernels."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

__all__ = ["ARCHITECTURES", "Figures", "assemble", "find_ptxas"]

#: Turing, Ampere, Hopper and Blackwell.
ARCHITECTURES = ("sm_75", "sm_80", "sm_90", "sm_100")


@dataclass(frozen=True)
class Figures:
    """What ``ptxas`` says of a kernel: registers of a thread, and bytes of local memory and of registers spilled there."""

    registers: int
    stack: int
    spills: int


def find_ptxas() -> str | None:
    """Return the path of ``ptxas``: of the search path, else of NVIDIA's wheel; None if there is none."""
    found = shutil.which("ptxas")
    if found is not None:
        return found
    package = importlib.util.find_spec("nvidia")
    folders = [] if package is None else list(package.submodule_search_locations or [])
    paths = [path for folder in folders for path in sorted(Path(folder).glob("cu*/bin/ptxas"))]
    return str(paths[-1]) if paths else None


def assemble(ptxas: str, ptx: str, architecture: str) -> Figures:
    """Assemble a PTX text for an architecture.

    Raises:
        RuntimeError: what ``ptxas`` does not accept.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "kernel.ptx")
        source.write_text(ptx)
        command = [ptxas, "-v", f"-arch={architecture}", str(source), "-o", str(Path(folder, "kernel.cubin"))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = done.stdout + done.stderr
    if done.returncode:
        raise RuntimeError(told[:2000])

    def number(pattern: str) -> int:
        return max(map(int, re.findall(pattern, told)))

    return Figures(
        number(r"Used (\d+) registers"), number(r"(\d+) bytes stack frame"), number(r"(\d+) bytes spill stores")
    )
