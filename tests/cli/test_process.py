"""The command as a process of its own: signals, exit codes, and a real render."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from torchpt.cli import main as commands
from torchpt.cli.interrupt import Interrupt, Interrupted
from torchpt.cli.main import main
from torchpt.images import read_image, read_layers

from .conftest import SCENE

TORCHPT = [sys.executable, "-m", "torchpt"]


#: What a small render to a PNG file has no use for.
NEEDLESS = (
    *("trimesh", "kornia", "matplotlib", "numba", "OpenImageIO", "mitsuba"),
    *("networkx", "pandas", "pydantic", "rich", "scipy", "sympy", "triton"),
    *("torch._dynamo", "torch._inductor", "torch.onnx", "torch.utils.tensorboard"),
    "PIL.TiffImagePlugin",
    *(f"torchpt.scene.meshes.{name}" for name in ("gltf", "obj", "ply", "stl")),
    "torchpt.ranks.launch",
)
#: A small render, what was imported for it, and then the command as ``python -m`` runs it.
CODE = """
import json, runpy, sys
from torchpt.cli.main import main
assert main(["render", "scene=cornell_box", "render.spp=16", "film.width=64", "film.height=64", "out=small.png"]) == 0
print("imported", json.dumps([name for name in {needless!r} if name in sys.modules]))
sys.argv[1:] = {words!r}
runpy.run_module("torchpt", run_name="__main__", alter_sys=True)
"""


def test_real_renders_and_what_a_small_one_imports(tmp_path: Path) -> None:
    words = ["render", "scene=cornell_box", "film.width=16", "film.height=16", "render.spp=4"]
    words += ["out=[a.exr,a.png]", "film.aovs=[albedo,normal,depth,variance]", "render.preview=p.png"]
    code = CODE.format(needless=NEEDLESS, words=words)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert "imported []" in done.stdout.splitlines()
    (tmp_path / "small.png").unlink()
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


LONG = ["render", "scene=s.yaml", "render.spp=1000000", "render.compile=off", "out=a b.exr", "render.preview=p.exr"]


def check_partial(folder: Path, out: str, err: str) -> None:
    (said,) = (line for line in err.splitlines() if "error is not known" not in line)
    assert "a b.exr holds the picture so far" in said
    facts = json.loads(out.splitlines()[-1])
    assert facts["complete"] is False
    assert torch.isfinite(read_image(folder / "a b.exr")).all()
    assert {name for name in os.listdir(folder) if name.startswith(".")} == set()


def wait_for(file: Path, ended: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 120
    while not file.exists() and time.monotonic() < deadline and not ended():
        time.sleep(0.02)


def test_a_signal_ends_a_long_render_with_its_partial_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SCENE.replace("width: 8, height: 6", "width: 64, height: 64"))
    ended = threading.Event()

    def interrupt() -> None:
        wait_for(tmp_path / "p.exr", ended.is_set)
        if not ended.is_set():
            os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        code = main(LONG)
    finally:
        ended.set()
        thread.join()
    assert code == 130
    captured = capfd.readouterr()
    check_partial(tmp_path, captured.out, captured.err)


@pytest.mark.slow
@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_a_process(tmp_path: Path, signum: int, code: int) -> None:
    (tmp_path / "s.yaml").write_text(SCENE.replace("width: 8, height: 6", "width: 64, height: 64"))
    with subprocess.Popen([*TORCHPT, *LONG], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            wait_for(tmp_path / "p.exr", lambda: process.poll() is not None)
            process.send_signal(signum)
            out, err = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == code, err
    check_partial(tmp_path, out.decode(), err.decode())


def test_a_signal_that_python_wraps_ends_as_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where it arrives in ``__set_name__`` while a module is imported."""

    def wrapped(words: list[str], interrupt: Interrupt) -> int:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            raise AssertionError("no signal came")
        except Interrupted as arrived:
            raise RuntimeError("Error calling __set_name__") from arrived

    command = commands.Command("wrapped", "", "", "", wrapped)
    monkeypatch.setattr(commands, "COMMANDS", (*commands.COMMANDS, command))
    assert main(["wrapped"]) == 143


def test_an_error_of_no_signal_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(words: list[str], interrupt: Interrupt) -> int:
        raise RuntimeError("a defect") from ValueError()

    monkeypatch.setattr(commands, "COMMANDS", (commands.Command("broken", "", "", "", broken),))
    with pytest.raises(RuntimeError, match="a defect"):
        main(["broken"])
