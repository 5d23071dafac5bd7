from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from few import few

from torchpt.cli.main import main
from torchpt.cli.render import plain, sentence
from torchpt.core.errors import OutputError
from torchpt.images import read_header, read_image, read_layers
from torchpt.images.colour import TONEMAPS
from torchpt.rendering import result as files_module

from .conftest import SCENE, Renderer

ODD = ["a b (1).exr", "x=[1],{y}.png", "ü ~'\"$.exr", "a,b.png", "[odd].jpg"]


def files(folder: Path) -> set[str]:
    return set(os.listdir(folder)) - {"s.yaml"}


def summary(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out.splitlines()[-1])


def test_the_last_line_is_json(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "scene=s.yaml", "out=a.exr"]) == 0
    captured = capsys.readouterr()
    facts = json.loads(captured.out.splitlines()[-1])
    assert facts.pop("load_seconds") >= 0
    assert facts == {  # no job of a sweep
        "out": "a.exr",
        "spp": 4,
        "seconds": 1.5,
        "paths_per_second": 2e6,
        "rays": 77,
        "nonfinite_samples": 0,
        "mean": [1.0, 1.0, 1.0],
        "relmse": None,
    }
    assert captured.err == ""  # no progress bar where stderr is no terminal
    assert files(folder) == {"a.exr"}
    assert read_header("a.exr") == {"spp": 4, "relmse": 0.125, "relmse_low": 0.0625}


def test_a_sentence_for_people_stands_before_it(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", "scene=s.yaml", "out=[a.exr,b.png]"]) == 0
    said, line = capsys.readouterr().out.splitlines()
    assert said == "a.exr, b.png: 8 x 6 pixels, 4 samples a pixel, 1.5 s" and json.loads(line)["spp"] == 4


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"spp": 1, "seconds": 0.0123}, "a.exr: 4 x 3 pixels, 1 sample a pixel, 0.012 s"),
        ({"seconds": 1234.5, "relmse": 0.0004}, "1234 s; relative error 2 %"),
        ({"relmse": 4.0, "relmse_interval": [1.0, 1e4], "heavy_tailed": True},
         "relative error 200 % (100 to 10000 %), most of it in few pixels"),
        ({"relmse": None, "relmse_interval": None}, "16 samples a pixel, 2 s"),
        ({"relmse": 0.0, "stopped_by": "target_error"}, "; relative error 0 %; ended by render.target_error"),
        ({"complete": False, "stopped_by": "time_limit"}, "; stopped early"),
    ],
)  # fmt: skip
def test_what_the_sentence_says(facts: dict[str, Any], said: str) -> None:
    assert sentence({"out": "a.exr", "spp": 16, "seconds": 2.0, **facts}, 4, 3).endswith(said)


def test_numbers_of_the_summary_have_six_digits() -> None:
    values = {"a": [1 / 3, 123456789.123], "b": 123456789, "c": 1e-9 / 7, "d": True, "e": float("inf"), "f": 0.1}
    shown = {"a": [0.333333, 123457000.0], "b": 123456789, "c": 1.42857e-10, "d": True, "e": None, "f": 0.1}
    assert plain(values, digits=6) == shown
    assert plain(values)["a"] == values["a"]


def test_the_summary_and_the_header_tell_the_error(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lamp = "shapes: {lamp: {type: sphere, center: [2, 2, -2], radius: 0.5, emission: 5}, "
    sky = "lights: {sky: {type: constant, radiance: 0.1}}\n"
    (folder / "s.yaml").write_text(SCENE.replace("shapes: {", lamp) + sky)
    assert main(["render", "scene=s.yaml", "out=a.exr", "film.width=48", "film.height=32"]) == 0
    facts, header = summary(capsys), read_header("a.exr")
    found = (facts["relmse"], *facts["relmse_interval"])
    assert found == pytest.approx([header[name] for name in ("relmse", "relmse_low", "relmse_high")], rel=5e-6)
    assert 0 < found[1] < found[0] < found[2]
    timed = [f"{part}_seconds" for part in ("load", "build", "compile", "render")]
    assert {name: facts[name] for name in timed} == {name: pytest.approx(header[name], abs=1e-4) for name in timed}
    assert facts["spp"] == header["spp"] == 4 and header["scene"] == "s"
    assert main(["render", "scene=s.yaml", "out=b.exr", "render.pilots=false"]) == 0
    assert summary(capsys)["relmse"] is None and "relmse" not in read_header("b.exr")


def test_settings_reach_the_renderer(folder: Path, renderer: Renderer) -> None:
    words = "film.width=16 film.filter=box integrator.max_depth=3 sampler=independent render.spp=2 render.compile=off"
    assert main(["render", "scene=s.yaml", *words.split(), "film.aovs=[albedo,depth]", "out=a.exr"]) == 0
    settings = renderer.settings[0]
    assert (settings.film.width, settings.film.height) == (16, 12)  # given; in the scene's shape, 8 x 6
    assert settings.film.filter.name == "box" and settings.film.aovs == ("albedo", "depth")
    assert settings.integrator.max_depth == 3 and settings.integrator.clamp == 10
    assert settings.sampler.name == "independent" and settings.render.spp == 2 and settings.render.compile == "off"


@pytest.mark.parametrize(
    "word", ["film.filter.stddev=null", "film.filter.stddev=Null", "film={filter: {stddev: null}}"]
)
def test_null_below_a_block_unsets_it_in_any_spelling(folder: Path, renderer: Renderer, word: str) -> None:
    """A scene's own width of a filter gives way to the default."""
    (folder / "wide.yaml").write_text("defaults: [s]\nfilm: {filter: {type: gaussian, stddev: 3}}\n")
    assert main(["render", "scene=wide.yaml"]) == 0 and main(["render", "scene=wide.yaml", word]) == 0
    assert [settings.film.filter.values["stddev"] for settings in renderer.settings] == [3.0, 0.5]


def test_an_explicit_null_unsets_the_scenes_wish(folder: Path, renderer: Renderer) -> None:
    assert main(["render", "scene=s.yaml", "integrator.clamp=null", "render.spp=null", "film.filter.type=box"]) == 0
    assert renderer.settings[0].integrator.clamp is None and renderer.settings[0].render.spp == 64
    assert renderer.settings[0].film.filter.name == "box"


@pytest.mark.parametrize("name", few(ODD, 3))
def test_any_name_of_a_picture(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], name: str) -> None:
    assert main(["render", "scene=s.yaml", f"out={name}"]) == 0
    assert files(folder) == {name}
    assert summary(capsys)["out"] == name


def test_any_name_of_a_scene(folder: Path, renderer: Renderer) -> None:
    scene = folder / "d [x]" / "a b=(1),{c}.yaml"
    scene.parent.mkdir()
    scene.write_text(SCENE)
    assert main(["render", f"scene={scene}"]) == 0
    assert files(folder) == {"d [x]", "a b=(1),{c}.png"}


def test_several_pictures_at_once(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "scene=s.yaml", "out=[a.exr, b c.png,'d,e.hdr',\"f.ppm\"]"]) == 0
    assert files(folder) == {"a.exr", "b c.png", "d,e.hdr", "f.ppm"}
    assert summary(capsys)["out"] == ["a.exr", "b c.png", "d,e.hdr", "f.ppm"]


def test_default_names(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "scene=s.yaml"]) == 0
    assert main(["render", "scene=s.yaml", "film.aovs=[albedo]"]) == 0  # layers ask for a format that keeps them
    assert files(folder) == {"s.png", "s.exr"}
    assert set(read_layers("s.exr")) == {"image", "albedo"}
    assert main(["render", "scene=s.yaml", "film.aovs=[albedo]", "out=a.png"]) == 2
    assert "film.aovs" in capsys.readouterr().err


def test_display_settings_reach_the_8_bit_picture(folder: Path, renderer: Renderer) -> None:
    words = ["film.exposure=-1", "film.gamma=1.0", "film.tonemap=reinhard"]
    assert main(["render", "scene=s.yaml", "out=[a.png,a.exr]", *words]) == 0
    assert torch.allclose(read_image("a.png", linear=True), torch.tensor(1 / 3), atol=2e-3)
    assert torch.equal(read_image("a.exr"), torch.ones(6, 8, 3))


@pytest.mark.parametrize("gamma", few([1 / 2.2, 0.6, 1.0], 1))
@pytest.mark.parametrize("curve", few(["none", "reinhard", "aces", "filmic"], 2))
def test_exposure_curve_and_exponent_reach_every_8_bit_picture_and_the_preview(
    folder: Path, renderer: Renderer, gamma: float, curve: str
) -> None:
    words = ["film.exposure=-2", f"film.gamma={gamma}", f"film.tonemap={curve}"]
    outs = ["a.png", "a.jpg", "a.ppm", "a.exr", "a.hdr"]
    assert main(["render", "scene=s.yaml", f"out=[{','.join(outs)}]", "render.preview=p.png", *words]) == 0
    level = TONEMAPS[curve](torch.tensor(0.25)).item() ** gamma
    for name in ("a.png", "a.jpg", "a.ppm", "p.png"):
        assert torch.allclose(read_image(name, linear=True), torch.tensor(level), atol=0.6 / 255), name
    for name in ("a.exr", "a.hdr"):  # linear, as rendered
        assert torch.equal(read_image(name), torch.ones(6, 8, 3)), name
    assert torch.allclose(read_image("p.albedo.png"), torch.tensor(0.5), atol=3e-3)  # a layer is no light: not exposed


def test_preview_shows_albedo_and_normal_first(folder: Path, renderer: Renderer) -> None:
    seen: list[tuple[set[str], float]] = []

    def look(done: int) -> None:
        now = files(folder)
        seen.append((now, read_image("p q=1.exr")[0, 0, 0].item() if "p q=1.exr" in now else 0.0))

    renderer.after_pass = look
    assert main(["render", "scene=s.yaml", "out=a.exr", "render.preview=p q=1.exr"]) == 0
    first = {"p q=1.albedo.exr", "p q=1.normal.exr"}
    assert seen[0] == (first, 0.0)
    assert [value for _, value in seen[1:]] == [0.25, 0.5, 0.75]
    assert files(folder) == {*first, "p q=1.exr", "a.exr"}
    assert read_image("p q=1.normal.exr")[0, 0].tolist() == [0, 0, 1]
    assert read_image("p q=1.exr")[0, 0, 0] == 1


def test_normals_are_shown_in_8_bits(folder: Path, renderer: Renderer) -> None:
    assert main(["render", "scene=s.yaml", "out=a.exr", "render.preview=p.png"]) == 0
    shown = read_image("p.normal.png", linear=True)[0, 0]
    assert torch.allclose(shown, torch.tensor([0.5, 0.5, 1.0]), atol=3e-3)


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_keeps_the_picture_so_far(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], signum: int, code: int
) -> None:
    before = signal.getsignal(signum)
    renderer.after_pass = lambda done: os.kill(os.getpid(), signum) if done == 2 else None
    assert main(["render", "scene=s.yaml", "out=[a.exr,b.png]", "render.preview=p.exr"]) == code
    captured = capsys.readouterr()
    facts = json.loads(captured.out.splitlines()[-1])
    assert facts["spp"] == 2 and facts["complete"] is False
    assert len(captured.err.splitlines()) == 1 and "a.exr holds the picture so far" in captured.err
    for name in ("a.exr", "p.exr"):
        assert torch.equal(read_image(name), torch.full((6, 8, 3), 0.5))
    assert signal.getsignal(signum) is before


def test_a_signal_before_there_is_a_picture(
    folder: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchpt.scene import devices as loading

    monkeypatch.setattr(loading, "device_of", lambda name: os.kill(os.getpid(), signal.SIGTERM))
    assert main(["render", "scene=s.yaml"]) == 143
    assert files(folder) == set() and capsys.readouterr() == ("", "")


def test_a_failed_write_does_not_cost_the_other_pictures(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "sub").mkdir()
    renderer.after_pass = lambda done: (folder / "sub").rmdir() if done == 4 else None
    assert main(["render", "scene=s.yaml", "out=[sub/a.png,b.png]"]) == 2
    captured = capsys.readouterr()
    assert files(folder) == {"b.png"} and len(captured.err.splitlines()) == 1 and "sub/a.png" in captured.err


def test_every_picture_that_is_saved_elsewhere_is_named(
    folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("full", "home"):
        (folder / name).mkdir()
    monkeypatch.setenv("HOME", str(folder / "home"))
    write = files_module.write_rendered

    def refused(path: str | os.PathLike[str], *rest: Any) -> None:
        if Path(path).parent.name == "full" and Path(path).suffix == ".exr":
            raise OutputError(path, "cannot be written (No space left on device)")
        write(path, *rest)

    monkeypatch.setattr(files_module, "write_rendered", refused)
    assert main(["render", "scene=s.yaml", "out=[full/a.png,full/b.exr,full/c.exr]"]) == 2
    captured = capsys.readouterr()
    said = captured.err.splitlines()
    assert len(said) == 1 and captured.out == ""
    saved = sorted((folder / "home").iterdir())
    assert [path.name[:2] for path in saved] == ["b-", "c-"] and all(str(path) in said[0] for path in saved)
    assert said[0].count("No space left on device") == 2 and "full/b.exr" in said[0] and "full/c.exr" in said[0]
    assert [path.name for path in (folder / "full").iterdir()] == ["a.png"]


def test_multirun_numbers_the_pictures(folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "t, u.yaml").write_text(SCENE.replace("width: 8", "width: 4"))
    words = ["scene=s.yaml,'t, u.yaml'", "render.spp=1,2", "out=[a b.exr,c=1.png]", "render.preview=p.exr"]
    assert main(["render", "-m", *words]) == 0
    made = {f"{stem}_{n}{end}" for n in range(4) for stem, end in [("a b", ".exr"), ("c=1", ".png"), ("p", ".exr")]}
    made |= {f"p_{n}.{layer}.exr" for n in range(4) for layer in ("albedo", "normal")}
    assert files(folder) == made | {"t, u.yaml"}
    assert [(s.film.width, s.render.spp) for s in renderer.settings] == [(8, 1), (8, 2), (4, 1), (4, 2)]
    captured = capsys.readouterr()
    lines = [json.loads(line) for line in captured.out.splitlines() if line.startswith("{")]
    assert [line["out"][0] for line in lines] == [f"a b_{n}.exr" for n in range(4)]
    words = [[f"scene={scene}", f"render.spp={spp}"] for scene in ("s.yaml", "t, u.yaml") for spp in (1, 2)]
    assert [(line["job"], line["overrides"]) for line in lines] == list(enumerate(words))
    told = captured.err.splitlines()
    jobs, heading, rows = told[:4], told[4], told[5:]
    assert jobs == [f"torchpt: job {n}: {' '.join(each)} -> a b_{n}.exr, c=1_{n}.png" for n, each in enumerate(words)]
    assert heading.split() == ["job", "overrides", "out", "error", "seconds"] and len(rows) == 4
    assert [row.split("  ")[0] for row in rows] == ["0", "1", "2", "3"] and "render.spp=2" in rows[1]


def test_multirun_stops_at_a_signal(folder: Path, renderer: Renderer) -> None:
    renderer.after_pass = lambda done: os.kill(os.getpid(), signal.SIGINT) if done == 2 else None
    assert main(["render", "--multirun", "scene=s.yaml", "render.spp=3,5"]) == 130
    assert files(folder) == {"s_0.png"}


@pytest.mark.slow  # a sweep of `info` is over groups too
def test_multirun_over_groups_without_out(folder: Path, renderer: Renderer) -> None:
    assert main(["render", "-m", "scene=s.yaml", "sampler=independent", "integrator=path,direct"]) == 0
    assert files(folder) == {f"s_{n}.png" for n in range(2)}
    kinds = [(s.sampler.name, s.integrator.name) for s in renderer.settings]
    assert kinds == [("independent", i) for i in ("path", "direct")]


def test_a_defect_keeps_its_trace(folder: Path, renderer: Renderer) -> None:
    def broken(done: int) -> None:
        raise RuntimeError("a defect")

    renderer.after_pass = broken
    with pytest.raises(RuntimeError, match="a defect"):
        main(["render", "scene=s.yaml", "render.spp=4"])
    assert files(folder) == set()
