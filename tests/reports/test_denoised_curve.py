"""`torchpt converge denoise=true`: denoised pictures have curves of their own, and change nothing of the others."""

from __future__ import annotations

import json
import re
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

from torchpt.cli.main import main
from torchpt.core.errors import SceneError
from torchpt.images import read_image
from torchpt.rendering.api import render_scene
from torchpt.reports import runs
from torchpt.reports.analysis import SceneReport, analyse
from torchpt.reports.plots import curves
from torchpt.reports.runs import Measured, Store, prepare
from torchpt.reports.study import Study, study_of

SCENE = """\
camera: {origin: [0, 1, 4], target: [0, 0.5, 0], fov: 50}
film: {width: 24, height: 16, denoise: true, aovs: [variance]}
integrator: {max_depth: 3}
shapes:
  ball: {type: sphere, center: [0, 0.5, 0], radius: 0.5}
  floor: {type: rectangle, transform: [{rotate: {axis: [1, 0, 0], angle: -90}}, {scale: 4}]}
  lamp: {type: rectangle, emission: 9, transform: [{scale: 0.4}, {translate: [0, 2, -1]}]}
"""
WORDS = ["scene=s.yaml", "sampler=[independent,sobol]", "spp=[1,4]", "seeds=2", "reference.spp=64", "reference.seeds=2"]
WORDS += ["metrics=[relmse,mse]", "render.compile=off", "out=study"]
RAW: dict[str, Any] = {
    "scene": "s.yaml",
    "sampler": ["independent", "sobol"],
    "spp": [1, 4],
    "seeds": 2,
    "reference": {"spp": 64, "seeds": 2},
    "metrics": ["relmse", "mse"],
    "render.compile": "off",
}
LABELS = ["independent", "independent, denoised", "sobol", "sobol, denoised"]

there = pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed (extra `denoise`)")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene, and two studies of it: ``plain``, and ``study`` with denoised curves."""
    place = tmp_path_factory.mktemp("denoised")
    (place / "s.yaml").write_text(SCENE)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(["converge", *WORDS]) == 0
        shutil.copytree(place / "study", place / "plain")
        assert main(["converge", *WORDS, "denoise=true"]) == 0
    return place


@pytest.fixture
def folder(finished: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(finished)
    return finished


def told(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "report.json").read_text())["scenes"][0]["curves"]


def measured(folder: Path) -> tuple[Study, Measured]:
    """The finished study, nothing rendered."""
    study = study_of({**RAW, "denoise": True})
    (scene,) = prepare(study)
    runs.measure(study, [scene], Store(folder / "study" / "runs"))
    return study, scene


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> SceneReport:
    """Of such a study with fewer samples, without words and files."""
    place = tmp_path_factory.mktemp("small")
    (place / "s.yaml").write_text(SCENE)
    raw = {**RAW, "scene": str(place / "s.yaml"), "reference": {"spp": 16, "seeds": 2}, "denoise": True}
    study = study_of(raw)
    (scene,) = prepare(study)
    with pytest.MonkeyPatch.context() as patch:  # which pictures they are is not the question
        patch.setattr("torchpt.images.denoiser.denoise", lambda image, **_: 0.5 * (image + image.mean((0, 1))))
        runs.measure(study, [scene], Store(place / "runs"))
    return analyse(study, scene)


def scene_report(folder: Path) -> SceneReport:
    return analyse(*measured(folder))


@there
@pytest.mark.slow
def test_a_second_curve_stands_beside_each_and_changes_nothing_of_it(folder: Path) -> None:
    found, plain = told(folder / "study"), told(folder / "plain")
    assert [curve["label"] for curve in found] == LABELS
    assert [curve["denoised"] for curve in found] == [False, True, False, True]
    noisy = found[::2]
    for key in ("slope_over_spp", "bias", "steps", "times"):
        assert [curve[key] for curve in noisy] == [curve[key] for curve in plain], "the same runs, to the second"
    for one, other in zip(noisy, found[1::2], strict=True):
        assert other["slope_over_spp"] is other["slope_over_seconds"] is None
        assert other["bias"]["biased"] in (True, False)
        for before, after in zip(one["steps"], other["steps"], strict=True):
            assert after["efficiency"] is after["variance"] is None and before["efficiency"] is not None
            assert after["seeds"] == before["seeds"] and after["spp"] == before["spp"]
        assert other["steps"][0]["errors"] != one["steps"][0]["errors"], "they are other pictures"


@there
@pytest.mark.slow
def test_what_is_denoised_is_the_run_to_the_bit_and_seconds_hold_all_of_it(folder: Path) -> None:
    from torchpt.images.denoiser import denoise

    _, scene = measured(folder)
    for curve in scene.curves:
        assert curve.denoised is not None and curve.denoised.facts["denoiser"].startswith("pyoidn 2.")
        assert curve.job.settings.film.denoise is False and curve.job.settings.film.aovs == (), (
            "no wish of the scene's file"
        )
        for spp in (1, 4):
            noisy, run = curve.steps[spp][1], curve.denoised_steps[spp][1]
            settings = curve.denoised.settings
            settings = runs.replace(settings, render=settings.render.but(spp=spp, seed=noisy.facts["seed"]))
            again = render_scene(curve.job.scene, settings)
            assert torch.equal(again.image.double(), noisy.image())
            assert set(again.guides) == {"albedo", "normal"} and again.relmse is None, "no pilots"
            assert torch.equal(denoise(again.image, **again.guides).double(), run.image())
            assert run.seconds > run.facts["denoise_seconds"] > 0
            assert noisy.facts["denoise_seconds"] is None


@there
@pytest.mark.slow
def test_the_page_and_the_plots_tell_them_apart(folder: Path) -> None:
    bare = re.sub(r'"data:[^"]*"', "", (folder / "study" / "report.html").read_text())
    for words in ("sobol, denoised", "○", "□", "Denoised pictures are guesses", "and of denoising"):
        assert words in bare
    assert "enoised" not in re.sub(r'"data:[^"]*"', "", (folder / "plain" / "report.html").read_text())
    found = scene_report(folder)
    for over in ("seconds", "spp"):
        lines = curves(found, "relmse", over).axes[0].get_lines()
        drawn = {line.get_label().partition("   ")[0]: line for line in lines}
        for name in LABELS[::2]:
            one, other = drawn[name], drawn[f"{name}, denoised"]
            assert one.get_color() == other.get_color() and one.get_marker() == other.get_marker()
            assert one._unscaled_dash_pattern != other._unscaled_dash_pattern and other.get_markerfacecolor() == "white"
            assert "slope" not in other.get_label()


@there
def test_no_figure_of_the_others_is_found_by_them(small: SceneReport) -> None:
    found = small
    assert [line.denoised_from is None for line in found.lines] == [True, False, True, False]
    (level,) = found.targets
    noisy = [line for line in found.lines if line.denoised_from is None]
    assert level == float(f"{max(line.steps[-1].estimate('relmse').mean for line in noisy):.2g}")
    assert all(line.floor == 0.0 for line in found.lines if line.denoised_from is not None)
    for line in found.lines:
        if line.denoised_from is not None:
            assert all(item["seconds"] is None or not item["extrapolated"] for item in line.times)


@there
@pytest.mark.slow
def test_denoised_pictures_are_kept_like_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    render = runs.render_scene

    def counted(scene: Any, settings: Any, on_progress: Any) -> Any:
        seen.append(settings.film.denoise)
        return render(scene, settings, on_progress=on_progress)

    monkeypatch.setattr(runs, "render_scene", counted)
    before = told(folder / "study")
    assert main(["converge", *WORDS, "denoise=true"]) == 0 and seen == []
    assert [curve["steps"] for curve in told(folder / "study")] == [curve["steps"] for curve in before]
    shutil.copytree(folder / "study" / "runs", folder / "newer" / "runs")
    monkeypatch.setattr(runs, "denoiser_version", lambda: "pyoidn 3")
    words = [word.replace("out=study", "out=newer") for word in WORDS]
    assert main(["converge", *words, "denoise=true"]) == 0
    assert seen == [True] * (8 + 4), "another denoiser: only these, and one that is thrown away for each turn"
    for one, other in zip(told(folder / "newer"), before, strict=True):
        assert [s["errors"] for s in one["steps"]] == [s["errors"] for s in other["steps"]]
    pictures = [read_image(path) for path in (folder / "newer" / "runs").glob("*.exr")]
    assert len(pictures) == 8 + 2 + 8 + 8 and all(torch.isfinite(picture).all() for picture in pictures)


def test_without_the_package_nothing_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(SCENE)
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    assert main(["converge", *WORDS, "denoise=true"]) == 2
    captured = capfd.readouterr()
    assert captured.err.count("\n") == 1 and "pip install '.[denoise]' in the checkout of torchpt" in captured.err
    assert not captured.out and not (tmp_path / "study").exists()


@pytest.mark.parametrize(
    ("raw", "line"),
    [
        ({"denoise": "maybe"}, "denoise: expected true or false"),
        ({"film.denoise": True}, "film.denoise: expected denoise=true, which gives denoised pictures curves"),
        ({"film": [{"denoise": True}, {"width": 8}]}, "film.denoise: expected denoise=true"),
        (
            {"denoise": True, "extra": [{"name": "as the scene says, denoised", "seconds": 1, "file": "f"}]},
            "extra.0.name: expected a name that no curve has",
        ),
    ],
)
def test_bad_input(raw: dict[str, Any], line: str) -> None:
    with pytest.raises(SceneError, match=f"^{line}"):
        study = study_of({"scene": "cornell_box", **raw})
        study.overrides(study.variants[0])
