"""The command as a process of its own: signals, exit codes, and a real render."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from few import few

from torchpt.images import read_image, read_layers

from .conftest import SCENE

TORCHPT = [sys.executable, "-m", "torchpt"]


def test_a_real_render(tmp_path: Path) -> None:
    words = ["render", "scene=cornell_box", "film.width=16", "film.height=16", "render.spp=4"]
    words += ["out=[a.exr,a.png]", "film.aovs=[albedo,normal,depth,variance]", "render.preview=p.png"]
    done = subprocess.run([*TORCHPT, *words], cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0 and done.stderr == ""
    facts = json.loads(done.stdout.splitlines()[-1])
    assert facts["out"] == ["a.exr", "a.png"] and facts["spp"] == 4 and facts["nonfinite_samples"] == 0
    assert {"paths_per_second", "rays", "mean"} <= set(facts)
    assert facts["load_seconds"] > 0 and 0 < facts["build_seconds"] + facts["compile_seconds"] < facts["seconds"]
    layers = read_layers(tmp_path / "a.exr")
    assert set(layers) == {"image", "albedo", "normal", "depth", "variance"}
    assert layers["depth"].shape == (16, 16, 1) and layers["normal"].abs().max() <= 1.001
    assert torch.allclose(layers["image"].mean((0, 1)), torch.tensor(facts["mean"]), rtol=1e-4)
    assert read_image(tmp_path / "a.png").shape == (16, 16, 3)
    assert set(os.listdir(tmp_path)) == {"a.exr", "a.png", "p.png", "p.albedo.png", "p.normal.png"}


@pytest.mark.parametrize(("signum", "code"), few([(signal.SIGINT, 130), (signal.SIGTERM, 143)], 1))
def test_a_signal_ends_a_long_render_with_its_partial_picture(tmp_path: Path, signum: int, code: int) -> None:
    (tmp_path / "s.yaml").write_text(SCENE.replace("width: 8, height: 6", "width: 64, height: 64"))
    words = [
        "render",
        "scene=s.yaml",
        "render.spp=1000000",
        "render.compile=off",
        "out=a b.exr",
        "render.preview=p.exr",
    ]
    with subprocess.Popen([*TORCHPT, *words], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            deadline = time.monotonic() + 120
            while not (tmp_path / "p.exr").exists() and time.monotonic() < deadline and process.poll() is None:
                time.sleep(0.1)
            process.send_signal(signum)
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == code, err
    (said,) = (
        line
        for line in err.splitlines()
        if not any(text in line for text in (b"search kernels", b"error is not known"))
    )
    assert b"a b.exr holds the picture so far" in said
    facts = json.loads(out.splitlines()[-1])
    assert facts["complete"] is False
    assert torch.isfinite(read_image(tmp_path / "a b.exr")).all()
    assert {name for name in os.listdir(tmp_path) if name.startswith(".")} == set()
