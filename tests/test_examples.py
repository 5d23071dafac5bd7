"""The numbered examples of ``scripts/examples`` in a short form: few steps on a tiny film still go the right way."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from pytest import approx

import torchpt

FOLDER = Path(__file__).parent.parent / "scripts" / "examples"
#: Steps, size of the film, and to what part of itself the error falls at least.
SHORT = {
    "01_texture_and_roughness": (12, 16, 0.6),
    "02_environment_map": (15, 12, 0.8),
    "03_pose_by_silhouette": (15, 24, 0.7),
    "04_light_behind_an_occluder": (20, 20, 0.6),
    "05_camera_calibration": (25, 20, 0.8),
    "06_neural_bsdf": (25, 12, 0.6),
    "07_depth_network": (30, 16, 0.8),
}


def test_every_example_is_tested() -> None:
    assert sorted(path.stem for path in FOLDER.glob("[0-9]*.py")) == sorted(SHORT)


@pytest.mark.parametrize("name", SHORT)
def test_an_example_finds_what_it_looks_for(name, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))
    steps, size, part = SHORT[name]
    before, after = importlib.import_module(name).main(
        ["--out", str(tmp_path), "--steps", str(steps), "--size", str(size), "--seed", "3"]
    )
    assert 0 < after < part * before
    assert torchpt.read_image(tmp_path / f"{name}.png").std() > 0.01
    told = [float(number) for number in re.findall(r"\d+\.\d+", capsys.readouterr().out)]
    assert any(number in (approx(after, abs=1e-3), approx(100 * after, abs=0.06)) for number in told)
