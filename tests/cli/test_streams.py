"""Closed pipes, full disks, folders that vanish: exit codes, messages, and what is left."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import torchpt

SMALL = "scene=cornell_box film.width=16 film.height=16 render.spp=2 out=a.png"
TORCHPT = f"{shlex.quote(sys.executable)} -m torchpt"
needs_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")


def shell(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", line], cwd=folder, env=environment, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize(
    "words", [f"render {SMALL}", "info scene=cornell_box", "info scene=cornell_box --json", "--help", "render --help"]
)
def test_a_reader_that_has_enough_is_no_error(words: str, tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} {words} | head -c 5", tmp_path)
    assert found.returncode == 0 and "Traceback" not in found.stderr and "BrokenPipe" not in found.stderr
    assert len(found.stdout) == 5
    assert (tmp_path / "a.png").exists() == words.startswith("render s")


def test_a_reader_that_is_gone_already(tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} render {SMALL} | true", tmp_path)
    assert found.returncode == 0 and "Traceback" not in found.stderr and (tmp_path / "a.png").exists()


@needs_full
@pytest.mark.parametrize("words", [f"render {SMALL}", "info scene=cornell_box", "--version"])
def test_a_full_disk_behind_stdout_is_told(words: str, tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} {words} > /dev/full", tmp_path)
    assert found.returncode == 2
    assert found.stderr.strip().splitlines()[-1] == (
        "torchpt: standard output: cannot be written (No space left on device)"
    )
    assert "Traceback" not in found.stderr and (tmp_path / "a.png").exists() == words.startswith("render")


@pytest.mark.parametrize("how", ["2>&-", pytest.param("2>/dev/full", marks=needs_full), "1>&- 2>&-", "0<&-"])
def test_nobody_need_listen_to_stderr(how: str, tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} render {SMALL} {how}", tmp_path)
    assert found.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert torchpt.read_image(tmp_path / "a.png").shape == (16, 16, 3)
    if "1>" not in how:
        assert json.loads(found.stdout.splitlines()[-1])["spp"] == 2
    refused = shell(f"{TORCHPT} render scene=nowhere {how}", tmp_path)
    assert refused.returncode == 2 and refused.stdout == ""


@needs_full
def test_a_device_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.png").symlink_to("/dev/full")
    found = shell(f"{TORCHPT} render {SMALL}", tmp_path)
    assert found.returncode == 2 and found.stderr.strip() == (
        "torchpt: a.png: is a device or pipe, no file that could be replaced"
    )
    assert Path("/dev/full").is_char_device()


def test_a_working_folder_that_is_gone(tmp_path: Path) -> None:
    found = shell(f"mkdir gone; cd gone; rmdir ../gone; {TORCHPT} render {SMALL}", tmp_path)
    assert found.returncode == 2
    assert (
        found.stderr.strip()
        .splitlines()[-1]
        .endswith("the working folder is not there any more: change to one that is")
    )


def test_a_picture_whose_folder_went_away_is_saved_elsewhere(tmp_path: Path) -> None:
    place, home = tmp_path / "place", tmp_path / "home"
    place.mkdir()
    home.mkdir()
    words = [sys.executable, "-m", "torchpt", "render", "scene=cornell_box", "film.width=64", "film.height=64",
             "render.spp=1000000", f"out={place / 'a.exr'}", f"render.preview={tmp_path / 'p.png'}"]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "HOME": str(home)}
    work = subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + 60
    while not (tmp_path / "p.png").exists() and time.monotonic() < until:
        time.sleep(0.05)
    place.rmdir()
    work.send_signal(signal.SIGINT)
    _, said = work.communicate(timeout=60)
    (saved,) = home.glob("a-*.exr")
    assert work.returncode == 2 and f"the picture is in {saved}" in said and "Traceback" not in said
    assert torchpt.read_image(saved).shape == (64, 64, 3)
