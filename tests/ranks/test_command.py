"""`torchpt render` by several processes: what is written and said, how it ends, and what is left where one is killed."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from forks import Command, command

import torchpt

WORDS = ["render", "scene=cornell_box", "film.width=48", "film.height=32", "render.threads=1", "render.pilots=true"]
FILM = {"width": 48, "height": 32}


@pytest.fixture(scope="module")
def box() -> torchpt.Scene:
    scene = torchpt.load("cornell_box", device="cpu")
    torchpt.render(scene, spp=1, film=FILM, threads=1)  # what is imported and read by now, children have too
    return scene


def whole(box: torchpt.Scene, spp: int, **more: Any) -> torchpt.Rendering:
    return torchpt.render(box, spp=spp, film={**FILM, **more}, pilots=True, full=True, threads=1)


def test_one_picture_one_summary(box: torchpt.Scene, tmp_path: Path) -> None:
    started = command(2, [*WORDS, "render.spp=9", "film.aovs=[albedo]", "out=a.exr", "render.preview=p.png"], tmp_path)
    assert started.codes() == [0, 0] and started.lines() == []
    summary = json.loads(started.output.read_text().splitlines()[-1])
    found, expected = torchpt.read_layers(tmp_path / "a.exr"), whole(box, 9, aovs=["albedo"])
    assert torch.equal(found["image"], expected.image) and torch.equal(found["albedo"], expected.layers["albedo"])
    assert summary["rays"] == expected.rays and summary["spp"] == 9
    assert summary["relmse"] == float(f"{expected.relmse:.6g}")
    assert {path.name for path in tmp_path.glob("*.*")} == {"a.exr", "p.png", "p.albedo.png", "p.normal.png"}


@pytest.mark.parametrize(
    "words, said",
    [
        ([*WORDS, "film.size=3"], "film.size: unknown key"),
        ([*WORDS, "out=no/such/folder.exr"], "no/such/folder.exr"),
        ([*WORDS, "-m"], "-m: a sweep runs in one process"),
        ([*WORDS, "debug.pixel=[1,1]"], "one path is traced by one process"),
        (["orbit", "scene=cornell_box"], "orbit: runs in one process"),
    ],
)
def test_what_is_wrong_is_said_once(words: list[str], said: str, tmp_path: Path) -> None:
    started = command(3, words, tmp_path)
    assert started.codes() == [2, 2, 2]
    (line,) = started.lines()
    assert line.startswith("torchpt: ") and said in line and started.output.read_text() == ""


def test_what_is_not_set_is_named(tmp_path: Path) -> None:
    started = command(2, WORDS, tmp_path, env={"MASTER_ADDR": ""})
    assert started.codes() == [2, 2]
    assert started.lines() == ["torchpt: WORLD_SIZE is 2, but there is no MASTER_ADDR: start it by torchrun"]


@pytest.mark.parametrize("rank", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_signal_to_one_ends_all_with_the_picture_so_far(rank: int, tmp_path: Path) -> None:
    started = command(2, [*WORDS, "render.spp=1000000", "out=a.exr", "render.checkpoint=a.npz"], tmp_path, 0.1)
    _wait_for(tmp_path / "a.npz", started)
    os.kill(started.children[rank].pid, signal.SIGTERM)
    assert started.codes() == [143, 143]
    *warnings, last = started.lines()
    assert last == "torchpt: stopped by a signal; a.exr holds the picture so far; render.resume=true goes on"
    # A slow machine has few samples by then, and says that the error of so few is not known.
    assert all(line.startswith("torchpt: warning: the picture's error is not known") for line in warnings)
    summary = json.loads(started.output.read_text().splitlines()[-1])
    assert summary["complete"] is False and 0 < summary["spp"] < 1000000
    assert float(torchpt.read_image(tmp_path / "a.exr").mean()) > 0.05


def _wait_for(path: Path, started: Command) -> None:
    end = time.monotonic() + 60.0
    while not path.exists() and time.monotonic() < end and all(child.is_alive() for child in started.children):
        time.sleep(0.01)


@pytest.mark.parametrize("kills", [2, 20])
@pytest.mark.slow
def test_the_bits_after_kills(box: torchpt.Scene, kills: int, tmp_path: Path) -> None:
    """Whichever rank is killed and whenever: the others end soon, with one line; and what is resumed ends as if unharmed."""
    chance, spp = random.Random(kills), 1200 * kills + 1500
    words = [*WORDS, f"render.spp={spp}", "out=a.exr", "render.checkpoint=a.npz"]
    done = 0
    for k in range(kills):
        there = (tmp_path / "a.npz").exists()
        size = 2 + k % 2
        started = command(size, [*words, *(["render.resume=true"] if there else [])], tmp_path, 0.1)
        if not there:
            _wait_for(tmp_path / "a.npz", started)
        time.sleep(chance.uniform(0.0, 0.7))
        victim = chance.randrange(size)
        if not all(child.is_alive() for child in started.children):
            break
        started.children[victim].kill()
        killed = time.monotonic()
        time.sleep(0.1)
        for child in started.children:  # as torchrun does
            if child.is_alive():
                os.kill(child.pid, signal.SIGTERM)
        codes = started.codes()
        if codes == [0] * size:  # it was done
            break
        assert time.monotonic() - killed < 15.0
        done += 1
        told = started.errors.read_text()
        assert codes[victim] == -signal.SIGKILL, (codes, told)
        assert all(code in (2, 143) for k, code in enumerate(codes) if k != victim), (codes, told)
        (line,) = started.lines()
        assert line.startswith(("torchpt: ranks:", "torchpt: stopped by a signal")) and started.output.read_text() == ""
    assert done >= kills // 2
    last = command(2, [*words, "render.resume=true"], tmp_path)
    assert last.codes() == [0, 0] and last.lines() == []
    assert torch.equal(torchpt.read_image(tmp_path / "a.exr"), whole(box, spp).image)


def torchrun(size: int, words: list[str], folder: Path, *options: str) -> subprocess.Popen[str]:
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(size), *options]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([*launcher, "-m", "torchpt", *words], cwd=folder, env=environment,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip


@pytest.mark.slow
def test_torchrun(box: torchpt.Scene, tmp_path: Path) -> None:
    """By the real launcher, with an override that Hydra composes."""
    work = torchrun(2, [*WORDS, "render.spp=4", "out=a.exr", "integrator=direct"], tmp_path)
    output, errors = work.communicate(timeout=300)
    assert work.returncode == 0 and "torchpt:" not in errors.replace("torchpt: compiling", "")
    expected = torchpt.render(box, spp=4, film=FILM, integrator="direct", pilots=True)
    assert json.loads(output.splitlines()[-1])["out"] == "a.exr" and torch.equal(
        torchpt.read_image(tmp_path / "a.exr"), expected
    )


@pytest.mark.slow
@pytest.mark.parametrize("victim", [0, 1])
def test_torchrun_starts_again_what_was_killed(box: torchpt.Scene, victim: int, tmp_path: Path) -> None:
    spp = 30000
    words = [*WORDS, f"render.spp={spp}", "out=a.exr", "render.checkpoint=a.npz", "render.resume=true"]
    work = torchrun(2, words, tmp_path, "--max-restarts", "1")
    while not (tmp_path / "a.npz").exists() and work.poll() is None:
        time.sleep(0.05)
    os.kill(_rank(work.pid, victim), signal.SIGKILL)
    output, errors = work.communicate(timeout=300)
    assert work.returncode == 0, errors
    said = [line for line in errors.splitlines() if line.startswith("torchpt: ranks")]
    assert len(said) == 1 and json.loads(output.splitlines()[-1])["spp"] == spp
    assert torch.equal(torchpt.read_image(tmp_path / "a.exr"), whole(box, spp).image)


def _rank(launcher: int, rank: int) -> int:
    """The process of a rank among the children of torchrun."""
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                words = (folder / "environ").read_bytes().split(b"\0")
            except OSError:
                continue
            if parent == launcher and f"RANK={rank}".encode() in words:
                return int(folder.name)
    raise AssertionError("no such process")
