"""`film.denoise` on the command line: two files for each picture, or one line about why not."""

from __future__ import annotations

import json
import os
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpt.cli.main import main
from torchpt.core.errors import RenderError
from torchpt.images import denoiser, read_header, read_image, read_layers

from .conftest import SCENE, Renderer

ON = "film.denoise=true"


def files(folder: Path) -> set[str]:
    return set(os.listdir(folder)) - {"s.yaml"}


@pytest.fixture
def halved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """A denoiser that halves; the layers that it was given."""
    seen: list[tuple[str, ...]] = []

    def half(image: Tensor, **guides: Tensor) -> Tensor:
        seen.append(tuple(guides))
        return 0.5 * image

    monkeypatch.setattr(denoiser, "check_denoiser", lambda: None)
    monkeypatch.setattr(denoiser, "denoise", half)
    return seen


def test_both_pictures_are_written_and_named(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", "scene=s.yaml", ON, "out=[a.exr,b.c.png]", "film.aovs=[depth]", "film.gamma=1.0"]) == 0
    assert files(folder) == {"a.exr", "a.denoised.exr", "b.c.png", "b.c.denoised.png"}
    shown, line = capsys.readouterr().out.splitlines()
    assert "; denoised: a.denoised.exr, b.c.denoised.png" in shown
    facts = json.loads(line)
    assert facts["out"] == ["a.exr", "b.c.png"] and facts["denoised"] == ["a.denoised.exr", "b.c.denoised.png"]
    assert facts["denoise_seconds"] >= 0 and facts["mean"] == [1, 1, 1]  # of the picture as rendered
    assert halved == [("albedo", "normal")]
    assert set(read_layers("a.exr")) == {"image", "depth"} and set(read_layers("a.denoised.exr")) == {"image"}
    assert read_header("a.exr") == {"spp": 4, "relmse": 0.125, "relmse_low": 0.0625}
    assert read_header("a.denoised.exr") == {"spp": 4, "denoised": 1}  # whose error nobody knows
    assert torch.equal(read_image("a.exr"), 2 * read_image("a.denoised.exr"))
    assert torch.allclose(read_image("b.c.denoised.png", linear=True), torch.tensor(0.5), atol=2e-3)  # shown alike


def test_one_picture_is_one_name(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.yaml").write_text(SCENE.replace("film: {", "film: {denoise: true, "))  # a scene file may wish it
    assert main(["render", "scene=s.yaml"]) == 0
    facts = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (facts["out"], facts["denoised"]) == ("s.png", "s.denoised.png")
    assert main(["render", "scene=s.yaml", "film.denoise=false", "out=t.png"]) == 0
    assert "denoised" not in json.loads(capsys.readouterr().out.splitlines()[-1])
    assert files(folder) == {"s.png", "s.denoised.png", "t.png"}


def test_the_preview_is_of_what_is_rendered(folder: Path, renderer: Renderer, halved: list[Any]) -> None:
    assert main(["render", "scene=s.yaml", ON, "out=a.exr", "render.preview=p.exr"]) == 0
    assert torch.equal(read_image("p.exr"), torch.ones(6, 8, 3)) and len(halved) == 1
    assert "p.denoised.exr" not in files(folder)


def test_jobs_of_a_sweep_are_numbered(folder: Path, renderer: Renderer, halved: list[Any]) -> None:
    assert main(["render", "-m", "scene=s.yaml", ON, "render.spp=2", "out=a.exr"]) == 0  # of one job
    assert files(folder) == {"a_0.exr", "a_0.denoised.exr"}


def test_a_signal_leaves_both_pictures_so_far(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    renderer.after_pass = lambda done: os.kill(os.getpid(), signal.SIGINT) if done == 2 else None
    assert main(["render", "scene=s.yaml", ON, "out=a.exr"]) == 130
    assert torch.equal(read_image("a.denoised.exr"), torch.full((6, 8, 3), 0.25))
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["complete"] is False


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one line about a command that is refused."""
    assert main([*words]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1
    return captured.err


def test_without_the_package_nothing_is_rendered(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    line = refused(capsys, "render", "scene=s.yaml", ON)
    assert "needs the package pyoidn: pip install '.[denoise]' in the checkout of torchpt" in line
    assert files(folder) == set() and renderer.settings == []


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["out=[a.png,a.denoised.png]"], "film.denoise: expected another file than 'a.denoised.png' of out"),
        (
            ["out=a.png", "render.preview=a.denoised.png"],
            "film.denoise: expected another file than 'a.denoised.png' of render.preview",
        ),
        (["integrator=aov", "film.aovs=[depth]"], "film.denoise: expected false where integrator is aov"),
        (["film.denoise=maybe"], "film.denoise: expected true or false"),
    ],
)  # fmt: skip
def test_bad_input(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str], words: list[str], says: str
) -> None:
    first = [] if words[0].startswith("film.denoise") else [ON]
    assert says in refused(capsys, "render", "scene=s.yaml", *first, *words)
    assert files(folder) == set() and renderer.settings == []


def test_a_name_that_cannot_be_written_is_found_before(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "a.denoised.png").mkdir()
    assert "a.denoised.png: is a folder" in refused(capsys, "render", "scene=s.yaml", ON, "out=a.png")
    assert renderer.settings == []


def test_a_denoiser_that_fails_does_not_cost_the_picture(
    folder: Path,
    renderer: Renderer,
    halved: list[Any],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(image: Tensor, **guides: Tensor) -> Tensor:
        raise RenderError("denoising: out of memory")

    monkeypatch.setattr(denoiser, "denoise", fails)
    assert "denoising: out of memory" in refused(capsys, "render", "scene=s.yaml", ON, "out=a.exr")
    assert files(folder) == {"a.exr"} and torch.equal(read_image("a.exr"), torch.ones(6, 8, 3))


def test_a_failed_write_does_not_cost_the_others(
    folder: Path, renderer: Renderer, halved: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "sub").mkdir()
    renderer.after_pass = lambda done: (folder / "sub").rmdir() if done == 4 else None
    assert "sub/a.png" in refused(capsys, "render", "scene=s.yaml", ON, "out=[sub/a.png,b.png]")
    assert files(folder) == {"b.png", "b.denoised.png"}


def test_orbit_writes_frames_as_rendered(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "orbit", "scene=s.yaml", ON, "frames=2")
    assert "film.denoise: expected false: torchpt orbit writes frames as rendered" in line and files(folder) == set()
    words = ["frames=2", "render.spp=1", "render.compile=off", "keep=true"]
    assert main(["orbit", "scene=s.yaml", "out=a.gif", *words]) == 0
    (folder / "s.yaml").write_text(SCENE.replace("film: {", "film: {denoise: true, "))
    assert main(["orbit", "scene=s.yaml", "out=b.gif", *words]) == 0  # a scene file's wish is about pictures
    assert (folder / "a.gif").read_bytes() == (folder / "b.gif").read_bytes()


@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed (extra `denoise`)")
def test_the_denoiser_itself(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["scene=cornell_box", "film.width=32", "film.height=24", "render.spp=4", "film.crop=[3,2,21,13]"]
    assert main(["render", *words, "out=a.exr"]) == 0
    assert main(["render", *words, ON, "out=b.exr"]) == 0
    noisy, denoised = read_image("b.exr"), read_image("b.denoised.exr")
    assert torch.equal(noisy, read_image("a.exr")) and noisy.shape == denoised.shape == (13, 21, 3)
    rough = [float(image.diff(dim=1).abs().mean()) for image in (noisy, denoised)]
    assert rough[1] < 0.6 * rough[0]
    assert denoised.mean().item() == pytest.approx(noisy.mean().item(), rel=0.15)
