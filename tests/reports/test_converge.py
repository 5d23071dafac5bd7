"""`torchpt converge` from words to files, on pictures of a few pixels."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import torch

from torchpt.cli import progress
from torchpt.cli.main import main
from torchpt.images import write_image
from torchpt.reports import report, runs
from torchpt.reports.runs import seed_of

SCENE = """\
camera: {origin: [0, 1, 4], target: [0, 0.5, 0], fov: 50}
film: {width: 16, height: 12, filter: {type: box}}
integrator: {max_depth: 3, clamp: 50}
shapes:
  ball: {type: sphere, center: [0, 0.5, 0], radius: 0.5}
  floor: {type: rectangle, transform: [{rotate: {axis: [1, 0, 0], angle: -90}}, {scale: 4}]}
lights: {sky: {type: constant, radiance: 0.7}}
"""
WORDS = [
    "scene=s.yaml",
    "integrator.clamp=[null,0.1]",
    "sampler=[independent,sobol]",
    "spp=[1,4]",
    "seeds=3",
    "reference.spp=16",
    "reference.seeds=4",
    "render.compile=off",
    "out=study",
]


class Renders:
    """Counts renders, and may wish to stop."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: list[tuple[int, int]] = []
        self.most = 10**9
        render = runs.render_scene

        def counted(scene: Any, wishes: Any, on_progress: Any) -> Any:
            if len(self.seen) >= self.most:
                import os
                import signal

                os.kill(os.getpid(), signal.SIGINT)
            self.seen.append((wishes.render.spp, wishes.render.seed))
            return render(scene, wishes, on_progress=on_progress)

        monkeypatch.setattr(runs, "render_scene", counted)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scene, and a finished study of it in ``study``."""
    place = tmp_path_factory.mktemp("converge")
    (place / "s.yaml").write_text(SCENE)
    write_image(place / "theirs.exr", torch.full((12, 16, 3), 0.3))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        extra = "extra=[{name: theirs, seconds: 0.5, file: theirs.exr}]"
        assert main(["converge", *WORDS, extra, "title=Tests & <others>"]) == 0
    shutil.copytree(
        place / "study", place / "first", ignore=shutil.ignore_patterns("runs")
    )  # tests write the other anew
    return place


@pytest.fixture
def there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without plots, which take most of the time."""
    monkeypatch.setattr(report, "_figures", lambda *_: {})


def facts(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "report.json").read_text())


def test_the_report_says_what_the_runs_came_to(folder: Path) -> None:
    (scene,) = facts(folder / "first")["scenes"]
    curves = {curve["label"]: curve for curve in scene["curves"]}
    assert list(curves) == [
        "no clamp, independent",
        "no clamp, sobol",
        "clamp 0.1, independent",
        "clamp 0.1, sobol",
        "theirs",
    ]
    for label, curve in curves.items():
        if label == "theirs":
            assert curve["bias"] is None and curve["steps"][0]["seconds"] == 0.5
            continue
        assert curve["bias"]["biased"] is label.startswith("clamp"), label
        assert (curve["bias"]["share"] < -0.1) is label.startswith("clamp")
        assert [step["spp"] for step in curve["steps"]] == [1, 4]
        assert all(len(step["errors"]["relmse"]["runs"]) == len(set(step["seeds"])) == 3 for step in curve["steps"])
        assert curve["nonfinite_samples"] == 0
        assert set(curve["steps"][0]["errors"]) >= {"relmse", "relmse_trimmed", "mse", "smape", "psnr", "ssim"}
    free = curves["no clamp, independent"]
    assert free["slope_over_spp"]["low"] < -1 < free["slope_over_spp"]["high"]
    assert curves["no clamp, sobol"]["slope_over_spp"]["mean"] < free["slope_over_spp"]["mean"]
    assert free["settings"]["integrator"]["clamp"] is None, "a null unsets the scene's own wish"
    assert free["reference"]["settings"]["integrator"]["clamp"] is None and free["reference"]["spp"] == 16


def test_the_page_is_one_file_that_asks_for_nothing(folder: Path) -> None:
    text = (folder / "first" / "report.html").read_text()
    assert "<script" not in text and "Tests &amp; &lt;others&gt;" in text
    assert all(source.startswith("data:image/") for source in re.findall(r'(?:src|href)="([^"]*)"', text))
    bare = re.sub(r'"data:[^"]*"', "", text)
    assert not re.search(r"https?:|url\(|@import", bare)
    for words in ("biased", "none found", "theirs", "At equal time", "Where the error is"):
        assert words in bare
    plots = sorted(path.name for path in (folder / "first" / "plots").iterdir())
    assert plots == [f"s_{name}.{kind}" for name in ("measures", "seconds", "spp") for kind in ("png", "svg")]


@pytest.mark.slow
def test_a_finished_study_renders_nothing_and_a_larger_one_what_is_new(
    there: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    renders = Renders(monkeypatch)
    before = facts(there / "first")["scenes"][0]["curves"][:4]
    assert main(["converge", *WORDS, "metrics=[relmse,mse]"]) == 0 and renders.seen == []
    summary = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert [curve["biased"] for curve in summary["scenes"][0]["curves"]] == [False, False, True, True]
    after = facts(there / "study")["scenes"][0]["curves"]
    assert [c["steps"][1]["errors"]["mse"] for c in after] == [c["steps"][1]["errors"]["mse"] for c in before]
    one = [word for word in WORDS if not word.startswith("integrator")]
    assert (
        main(["converge", *(word.replace("[1,4]", "[1,4,5]") for word in one), "integrator.clamp=null", "metrics=mse"])
        == 0
    )
    fresh = [seed_of(0, "run", 5, number) for number in range(3)]
    assert sorted(seed for spp, seed in renders.seen if spp == 5) == sorted(2 * fresh)
    assert len(renders.seen) == 2 * 6, "a run that is thrown away goes before each"


def test_another_study_has_a_folder_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(SCENE)
    renders = Renders(monkeypatch)

    def write(study: Any, measured: Any, folder: Path) -> list[Any]:
        (folder / "report.html").write_text(f"{study.variants} {study.options}")
        return []

    monkeypatch.setattr(report, "write_report", write)
    words = ["scene=s.yaml", "spp=[1,2]", "seeds=2", "reference.spp=4", "reference.seeds=2", "render.compile=off"]
    words += ["metrics=mse", "film.width=8", "film.height=6"]

    def study(*more: str) -> tuple[str, str, int]:
        """Return the folder, what stderr says, and how many renders it took."""
        before = len(renders.seen)
        assert main(["converge", *words, *more]) == 0
        said = capfd.readouterr()
        return str(Path(json.loads(said.out.splitlines()[-1])["out"]).parent), said.err, len(renders.seen) - before

    def pages() -> dict[str, str]:
        return {path.parent.name: path.read_text() for path in Path().glob("*/report.html")}

    assert study("sampler=sobol")[:2] == ("s_converge", "")
    first = pages()
    moved = "torchpt: s_converge holds another study; this one is in {} (out= names another folder)\n"
    assert study("sampler=independent")[:2] == ("s_converge_2", moved.format("s_converge_2"))
    assert study("sampler=sobol", "integrator.max_depth=2")[:2] == ("s_converge_3", moved.format("s_converge_3"))
    assert {**pages(), **first} == pages()
    # The same study again, and one that only grew or is shown otherwise.
    assert study("sampler=sobol") == ("s_converge", "", 0)
    assert study("sampler=independent") == ("s_converge_2", moved.format("s_converge_2"), 0)
    assert study("sampler=sobol", "title=Again", "target=1") == ("s_converge", "", 0)
    words[1:3] = ["spp=[1,2,3]", "seeds=3"]
    assert study("sampler=sobol")[:2] == ("s_converge", "")
    words[1:3] = ["spp=[1,2]", "seeds=2"]
    assert study("sampler=sobol")[0] == "s_converge_4", "its report would say less"
    # A folder that was asked for is taken, with a word.
    said = "torchpt: s_converge_2 holds the report of another study, which this one's replaces; its runs stay\n"
    assert study("sampler=sobol", "out=s_converge_2")[:2] == ("s_converge_2", said)


def test_progress_is_told_in_lines_where_no_terminal_shows_a_bar(
    no_plots: None, there: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "SECONDS_PER_LINE", 0.0)
    words = ["scene=s.yaml", "spp=[1,2]", "seeds=2", "reference=theirs.exr", "render.compile=off", "metrics=mse"]
    assert main(["converge", *words, "out=told"]) == 0
    lines = capfd.readouterr().err.splitlines()
    found = [re.fullmatch(r"torchpt: told: (\d+) % of 1\.15k samples after \d+ s", line) for line in lines]
    parts = [int(match[1]) for match in found if match]
    assert len(parts) == len(lines)
    assert parts == sorted(parts) and parts[-1] == 100 and len(set(parts)) > 3


def test_print_keeps_things_whole_and_small() -> None:
    text = (Path(runs.__file__).parent / "report.html").read_text()
    style = text.partition("<style>")[2].partition("</style>")[0]
    printed = re.search(r"@media print \{(.*?)\n\}", style, re.DOTALL)
    assert printed is not None
    rules: dict[str, str] = {}
    for selectors, body in re.findall(r"([^{}]+)\{([^{}]*)\}", printed[1]):
        for selector in selectors.split(","):
            rules[selector.strip()] = rules.get(selector.strip(), "") + body
    for selector in ("figure", "tr", ".plots img", ".wide", ".headline", ".note"):
        assert rules[selector].split() == ["break-inside:", "avoid;"], selector
    assert not any("font-weight" in body for body in rules.values())


def test_a_signal_keeps_what_is_done(
    no_plots: None, there: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    renders = Renders(monkeypatch)
    renders.most = 4  # one that is thrown away and two runs, then another that is thrown away
    words = [word.replace("out=study", "out=stopped") for word in WORDS] + ["metrics=mse"]
    assert main(["converge", *words]) == 130
    assert "stopped by a signal; 3 of 28 runs are in stopped/runs" in capfd.readouterr().err
    assert len(list((there / "stopped" / "runs").glob("*.json"))) == 3
    assert not (there / "stopped" / "report.html").exists()
    renders.most, first = 10**9, len(renders.seen)
    assert main(["converge", *words]) == 0 and (there / "stopped" / "report.html").exists()
    again = [seed for _, seed in renders.seen[first:]]
    assert len(again) == 25 + 12, "runs that were missing, and one that is thrown away for each turn of a setting"
    whole, resumed = (facts(there / name)["scenes"][0]["curves"] for name in ("first", "stopped"))
    for one, other in zip(whole, resumed, strict=False):
        assert [s["errors"]["mse"] for s in one["steps"]] == [s["errors"]["mse"] for s in other["steps"]]


@pytest.mark.slow
def test_a_reference_from_a_file_is_exact(there: Path) -> None:
    words = [word for word in WORDS if not word.startswith(("reference", "out"))]
    assert main(["converge", *words, "reference=theirs.exr", "out=file", "metrics=[mse]", "target=[1,0.1]"]) == 0
    (scene,) = facts(there / "file")["scenes"]
    assert scene["targets"] == [1.0, 0.1] and any("taken to be exact" in note for note in scene["notes"])
    assert all(curve["bias"]["biased"] for curve in scene["curves"]), "it is no picture of the scene"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ([], "scene: expected scene=NAME, scene=FILE.yaml or study=FILE.yaml"),
        (["scene=s.yaml", "sampler=[sobol,nope]"], "sampler: expected one of default, hammersley"),
        (["scene=s.yaml", "integrator=[path,aov]"], "integrator.type: expected an integrator that carries light"),
        (["scene=s.yaml", "film.wide=3"], "film.wide: expected a known key"),
        (["scene=s.yaml", "spp=[a"], "spp: expected a value, or a list"),
        (["scene=s.yaml", "reference=none.exr"], "none.exr: "),
        (["scene=s.yaml", "film.width=8", "reference=theirs.exr"], "theirs.exr: expected a picture of 8 x 6 pixels"),
        (["scene=s.yaml", "extra=[{name: a, seconds: 1, file: none.exr}]"], "none.exr: "),
        (["scene=s.yaml", "out=s.yaml"], "s.yaml: is a file; expected a folder"),
        (["scene=[s.yaml,nope]"], "scene: expected one of ajar_door"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else "",
)
def test_bad_input_is_one_line(
    words: list[str], line: str, there: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    renders = Renders(monkeypatch)
    assert main(["converge", *words]) == 2
    captured = capfd.readouterr()
    assert captured.err.startswith(f"torchpt: {line}") and captured.err.count("\n") == 1 and not captured.out
    assert not renders.seen and not (there / "s_converge" / "report.html").exists()


@pytest.mark.slow
def test_a_browser_opens_it_without_a_word(folder: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium is installed")
    page = folder / "first" / "report.html"
    words = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--v=0",
        "--window-size=1280,2400",
    ]
    done = subprocess.run(
        [browser, *words, f"--screenshot={folder}/page.png", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    assert (folder / "page.png").stat().st_size > 20_000
    assert not re.search(r"CONSOLE|Refused|net::", done.stderr), done.stderr


def test_keys_of_a_scene_make_curves_with_references_of_their_own(
    no_plots: None, there: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = [
        "scene=s.yaml",
        "camera.fov=30,60",
        "spp=[1,2]",
        "seeds=2",
        "reference.spp=4",
        "reference.seeds=2",
        "metrics=mse",
    ]
    assert main(["converge", *words, "render.compile=off", "out=keys"]) == 0
    facts = json.loads(capfd.readouterr().out.splitlines()[-1])
    assert [curve["label"] for curve in facts["scenes"][0]["curves"]] == ["fov 30", "fov 60"]
    runs_of = [json.loads(path.read_text()) for path in (there / "keys" / "runs").glob("*.json")]
    scenes = {run["scene"] for run in runs_of}
    assert len(scenes) == 2 and len(runs_of) == 2 * (2 * 2 + 2)
    assert main(["converge", "scene=s.yaml", "camera.fo=30,60"]) == 2
    assert "torchpt: camera.fo: expected a known key" in capfd.readouterr().err
