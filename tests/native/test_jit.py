"""Numba's cache may fail in any way: kernels are compiled anew."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNEL = """
from torchpt.native.jit import jit

@jit()
def twice(x):
    return 2 * x

print(twice(21), len(twice.overloads), sum(twice.stats.cache_hits.values()))
"""


def run(folder: Path) -> list[str]:
    words = [sys.executable, str(folder / "kernel.py")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_CACHE_DIR": str(folder / "cache")}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.parametrize(
    "content",
    [None, pytest.param(b"", marks=pytest.mark.slow), pytest.param(b"\x80\x05garbage", marks=pytest.mark.slow)],
)
@pytest.mark.slow
def test_a_damaged_cache_costs_a_compilation(ending: str, content: bytes | None, tmp_path: Path) -> None:
    (tmp_path / "kernel.py").write_text(KERNEL)
    assert run(tmp_path) == ["42", "1", "0"]
    if ending == "nbi" and content is None:
        assert run(tmp_path) == ["42", "1", "1"]  # what is whole is used
    for file in (tmp_path / "cache").rglob(f"*.{ending}"):
        file.write_bytes(file.read_bytes()[:-7] if content is None else content)
    assert run(tmp_path) == ["42", "1", "0"]
