"""Sweeps by a launcher of Hydra that runs jobs in processes of their own: `hydra/launcher=joblib` (extra `sweep`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

import torchpt

WORDS = ["scene=cornell_box", "film.width=24", "film.height=16", "render.threads=1", "render.pilots=true"]
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("joblib") is None, reason="hydra-joblib-launcher is not installed (extra `sweep`)"),
]


def sweep(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(folder / "tmp")}
    (folder / "tmp").mkdir()
    return subprocess.run(
        [sys.executable, "-m", "torchpt", "render", "-m", *WORDS, *launcher, *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_jobs_of_several_processes_write_what_jobs_of_one_do(tmp_path: Path) -> None:
    done = sweep(tmp_path, "render.spp=1,2", "sampler=sobol,independent", "out=x.exr")
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()  # a sentence and a summary each
    facts = [json.loads(line) for line in lines[1::2]]
    assert [line.partition(": ")[0] for line in lines[::2]] == [fact["out"] for fact in facts]
    assert {fact["out"]: fact["job"] for fact in facts} == {f"x_{k}.exr": k for k in range(4)}
    assert all(
        f"torchpt: job {fact['job']}: {' '.join(fact['overrides'])} -> {fact['out']}" in done.stderr for fact in facts
    )
    scene = torchpt.load("cornell_box", device="cpu")
    film = {"width": 24, "height": 16}
    unknown = {fact["job"]: fact.get("relmse_unknown", "") for fact in facts}  # so few samples leave much of it black
    for number, (spp, sampler) in enumerate((spp, name) for spp in (1, 2) for name in ("sobol", "independent")):
        with warnings.catch_warnings(record=True, action="always", category=torchpt.NoLightWarning) as caught:
            image = torchpt.render(scene, spp=spp, sampler=sampler, film=film, pilots=True, threads=1)
        assert torch.equal(torchpt.read_image(tmp_path / f"x_{number}.exr"), image)
        assert "".join(str(warning.message).partition(": ")[2] for warning in caught) == unknown[number]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tmp", *(f"x_{k}.exr" for k in range(4))]
    assert list((tmp_path / "tmp").glob("torchpt-sweep-*")) == []


def test_a_job_that_is_wrong_leaves_the_others_pictures(tmp_path: Path) -> None:
    done = sweep(tmp_path, "render.spp=1,-3,2", "out=y.exr")
    assert done.returncode == 2
    assert [line for line in done.stderr.splitlines() if line.startswith("torchpt: render.spp: expected")]
    assert "Traceback" not in done.stderr and all((tmp_path / f"y_{k}.exr").exists() for k in (0, 2))


def test_keys_of_the_scene_give_the_same_pictures_by_either_launcher(tmp_path: Path) -> None:
    words = [
        "materials.white.reflectance=.2,[.1,.5,.9]",
        "render.spp=1",
        "camera.fov=range(20,41,20)",
        "~shapes.tall_box",
    ]
    done = sweep(tmp_path, *words, "out=x.exr")
    assert done.returncode == 0, done.stderr
    table = done.stderr.splitlines()[-5:]
    assert table[0].split() == ["job", "overrides", "out", "error", "seconds"]
    for number, (reflectance, fov) in enumerate((r, f) for r in (0.2, [0.1, 0.5, 0.9]) for f in (20, 40)):
        overrides = {"materials.white.reflectance": reflectance, "camera.fov": fov, "~shapes.tall_box": None}
        scene = torchpt.load("cornell_box", "cpu", overrides=overrides)
        film = {"width": 24, "height": 16}
        with warnings.catch_warnings(action="ignore", category=torchpt.NoLightWarning):
            image = torchpt.render(scene, spp=1, film=film, pilots=True, threads=1)
        assert torch.equal(torchpt.read_image(tmp_path / f"x_{number}.exr"), image)
        assert torchpt.read_header(tmp_path / f"x_{number}.exr")["overrides"] == " ".join(scene.description.overrides)
        assert f"camera.fov={fov}" in table[1 + number] and f"x_{number}.exr" in table[1 + number]
