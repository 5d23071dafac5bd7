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
from few import few

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
    "words",
    few([f"render {SMALL}", "info scene=cornell_box", "info scene=cornell_box --json", "--help", "render --help"], 1),
)
@pytest.mark.slow
def test_a_reader_that_has_enough_is_no_error(words: str, tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} {words} | head -c 5", tmp_path)
    assert found.returncode == 0 and "Traceback" not in found.stderr and "BrokenPipe" not in found.stderr
    assert len(found.stdout) == 5
    assert (tmp_path / "a.png").exists() == words.startswith("render s")


@pytest.mark.slow
def test_a_reader_that_is_gone_already(tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} render {SMALL} | true", tmp_path)
    assert found.returncode == 0 and "Traceback" not in found.stderr and (tmp_path / "a.png").exists()


@needs_full
@pytest.mark.parametrize("words", few([f"render {SMALL}", "info scene=cornell_box", "--version"], 1))
@pytest.mark.slow
def test_a_full_disk_behind_stdout_is_told(words: str, tmp_path: Path) -> None:
    found = shell(f"{TORCHPT} {words} > /dev/full", tmp_path)
    assert found.returncode == 2
    assert found.stderr.strip().splitlines()[-1] == (
        "torchpt: standard output: cannot be written (No space left on device)"
    )
    assert "Traceback" not in found.stderr and (tmp_path / "a.png").exists() == words.startswith("render")


@pytest.mark.parametrize("how", ["2>&-", pytest.param("2>/dev/full", marks=needs_full), "1>&- 2>&-", "0<&-"])
@pytest.mark.slow
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
@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_two_writers_of_one_picture(tmp_path: Path) -> None:
    """Each writes beside the file and puts it there in one step: what is left is one of both, whole."""
    words = [
        sys.executable,
        "-m",
        "torchpt",
        "render",
        "scene=cornell_box",
        "film.width=24",
        "film.height=24",
        "out=a.exr",
    ]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    both = [
        subprocess.Popen([*words, f"render.spp={spp}"], cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
        for spp in (1, 2, 3)
    ]
    assert [work.wait(120) for work in both] == [0, 0, 0]
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert torchpt.read_image(tmp_path / "a.exr").shape == (24, 24, 3)


@pytest.mark.slow
def test_two_writers_of_one_checkpoint(tmp_path: Path) -> None:
    """It is of the one or of the other, never of both: a render goes on from it to the bits of one that was left alone."""
    words = [sys.executable, "-m", "torchpt", "render", "scene=cornell_box", "film.width=24", "film.height=24"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    once = [*words, "render.spp=6", "render.checkpoint=c.npz", "render.resume=true"]
    both = [
        subprocess.Popen([*once, f"out={k}.exr"], cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL)
        for k in "ab"
    ]
    assert [work.wait(120) for work in both] == [0, 0]
    assert shell(f"{TORCHPT} render {' '.join(once[4:])} out=c.exr", tmp_path).returncode == 0
    assert shell(f"{TORCHPT} render {' '.join(words[4:])} render.spp=6 out=d.exr", tmp_path).returncode == 0
    pictures = [torchpt.read_image(tmp_path / f"{k}.exr") for k in "abcd"]
    assert all(picture.equal(pictures[0]) for picture in pictures)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.exr", "b.exr", "c.exr", "c.npz", "d.exr"]


@pytest.mark.skipif(os.name != "posix" or os.getuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    found = shell(f"{TORCHPT} render {SMALL.replace('a.png', 'closed/a.png')}", tmp_path)
    assert found.returncode == 2 and "closed/a.png" in found.stderr and found.stderr.count("\n") == 1


@pytest.mark.slow
def test_a_file_that_grows_no_further_leaves_nothing_half_written(tmp_path: Path) -> None:
    """A full disk, by the limit on the size of files: the picture that was there before is there still."""
    assert shell(f"{TORCHPT} render {SMALL}", tmp_path).returncode == 0
    before = (tmp_path / "a.png").read_bytes()
    large = SMALL.replace("width=16", "width=512").replace("height=16", "height=512")
    found = shell(f"trap '' XFSZ; ulimit -f 16; TORCHPT_CACHE= {TORCHPT} render {large} render.compile=off", tmp_path)
    assert found.returncode == 2 and "Traceback" not in found.stderr
    assert "cannot be written (File too large)" in found.stderr.strip().splitlines()[-1]
    assert (tmp_path / "a.png").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.skipif(os.name != "posix", reason="processes are asked by signals")
@pytest.mark.slow
def test_folders_of_killed_sweeps_go_with_the_next(tmp_path: Path) -> None:
    """Hydra's sweeper wants a folder; that of a process which is gone is nobody's, that of a living one is not touched."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (dead := tmp_path / f"torchpt-sweep-{gone.pid}-abc").mkdir()
    (dead / "multirun.yaml").write_text("")
    (mine := tmp_path / f"torchpt-sweep-{os.getpid()}-abc").mkdir()
    (other := tmp_path / "torchpt-sweep-of-mine").mkdir()
    line = f"TMPDIR={tmp_path} {TORCHPT} render -m {SMALL} render.spp=1,2"
    (place := tmp_path / "place").mkdir()
    found = shell(line, place)
    assert found.returncode == 0, found.stderr
    assert not dead.exists() and mine.exists() and other.exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([mine.name, other.name, "place"])
