"""The numbered examples of ``scripts/examples`` in a short form: few steps on a tiny film still go the right way."""

from __future__ import annotations

import importlib
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from pytest import approx

import torchpt
from torchpt.math.sampling import uniform_hemisphere

FOLDER = Path(__file__).parent.parent / "scripts" / "examples"
#: Steps, size of the film, and to what part of itself the error falls at least.
SHORT = {
    "01_texture_and_roughness": (25, 16, 0.7),
    "02_environment_map": (15, 12, 0.8),
    "03_pose_by_silhouette": (40, 24, 0.7),
    "04_light_behind_an_occluder": (40, 20, 0.6),
    "05_camera_calibration": (100, 16, 0.75),
    "06_neural_bsdf": (25, 12, 0.6),
    "07_depth_network": (30, 16, 0.8),
    "08_distributed": (12, 16, 0.6),
}


def test_every_example_is_tested() -> None:
    assert sorted(path.stem for path in FOLDER.glob("[0-9]*.py")) == sorted(SHORT)


@pytest.fixture
def example(monkeypatch):
    """Imports an example by its name, as it finds its helpers when it is run."""
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module


@pytest.mark.parametrize("name", [pytest.param(x, marks=[] if x[:2] == "02" else [pytest.mark.slow]) for x in SHORT])
def test_an_example_finds_what_it_looks_for(name, example, tmp_path, capsys) -> None:
    steps, size, part = SHORT[name]
    before, after = example(name).main(
        ["--out", str(tmp_path), "--steps", str(steps), "--size", str(size), "--seed", "3"]
    )
    assert 0 < after < part * before
    assert torchpt.read_image(tmp_path / f"{name}.png").std() > 0.01
    told = [float(number) for number in re.findall(r"\d+\.\d+", capsys.readouterr().out)]
    assert any(number in (approx(after, abs=1e-3), approx(100 * after, abs=0.06)) for number in told)


@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_workers_give_the_same_pictures(example, start, tmp_path, capsys) -> None:
    main = example("07_depth_network").main
    words = ["--out", str(tmp_path), "--steps", "2", "--size", "8"]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        assert main([*words, "--workers", "2", "--start", start]) == main(words)
    finally:
        torch.set_num_threads(threads)


def test_two_processes_of_torchrun_have_the_gradient_of_one(example, tmp_path) -> None:
    words = ["--steps", "3", "--size", "12"]
    launcher = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc-per-node",
        "2",
        str(FOLDER / "08_distributed.py"),
    ]
    # torch asks DNS for the name of the other side of each connection, and waits.
    environment = {**os.environ, "PYTHONPATH": str(FOLDER.parent.parent), "OMP_NUM_THREADS": "1"} | {
        "RES_OPTIONS": "attempts:0"
    }
    work = subprocess.run(
        [*launcher, *words, "--out", str(tmp_path / "two")],
        capture_output=True,
        text=True,
        env=environment,
        timeout=300,
    )
    assert work.returncode == 0, work.stderr
    assert work.stdout.startswith("2 processes: error of the paints")
    example("08_distributed").main([*words, "--out", str(tmp_path / "one")])
    one, two = (torch.load(tmp_path / name / "08_distributed.pt", weights_only=True) for name in ("one", "two"))
    largest = float(one["gradient"].abs().max())
    assert largest > 0
    torch.testing.assert_close(two["gradient"], one["gradient"], rtol=1e-5, atol=1e-6 * largest)
    torch.testing.assert_close(two["paints"], one["paints"], rtol=1e-5, atol=1e-6)


def test_a_pose_is_rigid(example) -> None:
    tools = example("example_tools")
    moved = tools.pose(torch.tensor([0.3, -0.4, 1.2]), torch.tensor([1.0, 2.0, 3.0]))
    assert tools.turned_by(moved, torch.eye(4)) == approx(math.degrees(1.3), abs=1e-3)
    assert torch.linalg.det(moved[:3, :3]).item() == approx(1.0, abs=1e-6)
    assert moved[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_the_learned_material_is_drawn_as_it_says(example) -> None:
    """What samples weigh on average is the integral of ``f cos``, and ``g = 1`` would give back no more than arrives."""
    torch.manual_seed(0)
    learned, count = example("06_neural_bsdf").Learned(), 200_000
    wo = torch.tensor([0.6, 0.0, 0.8])[:, None].expand(3, count)
    with torch.no_grad():
        drawn = learned.sample({}, wo, torch.rand(count), torch.rand(2, count))
        even = uniform_hemisphere(torch.rand(2, count))
        value, pdf = learned.eval_pdf({}, wo, even)
    by_quadrature = 2 * math.pi * value.mean(1)
    assert torch.allclose(drawn.weight.mean(1), by_quadrature, rtol=0.02)
    assert torch.all(drawn.weight <= 1)
    assert 0.9 < 2 * math.pi * pdf.mean() < 1.01
