"""A scene's name is the same in every process: what was rendered of it is found again."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

CODE = "import torchpt; from torchpt.scene.digest import digest; print(digest(torchpt.load('cornell_box', 'cpu')))"


@pytest.mark.slow
def test_two_processes_agree() -> None:
    found = set()
    for number in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": number}  # the order of sets follows from it
        done = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True)
        found.add(done.stdout)
    assert len(found) == 1
