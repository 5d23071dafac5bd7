"""What a study asks, from words and from files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from torchpt.cli.arguments import UsageError, parse_study
from torchpt.cli.converge import HELP, raw_study
from torchpt.core.errors import SceneError
from torchpt.reports.study import OWN_KEYS, read_study, study_of


def labels(raw: dict[str, Any]) -> list[str]:
    return [variant.label for variant in study_of({"scene": "cornell_box", **raw}).variants]


def test_lists_make_a_grid_and_labels_say_what_differs() -> None:
    assert labels({"sampler": ["sobol", "independent"], "integrator.max_depth": [4, 8], "film.width": 64}) == [
        "sobol, depth 4",
        "sobol, depth 8",
        "independent, depth 4",
        "independent, depth 8",
    ]
    assert labels({"sampler": ["sobol"]}) == labels({"film": {"width": 8}}) == ["as the scene says"]
    assert labels({"integrator.clamp": [None, 2.5]}) == ["no clamp", "clamp 2.5"]
    assert (
        labels({"integrator": ["path", {"type": "path", "clamp": 10, "rr_depth": 3}]})[1]
        == "path, clamp 10, rr depth 3"
    )
    assert labels({"film.filter.type": ["box", "tent"]}) == ["box", "tent"]
    assert labels({"film.crop": [0, 0, 8, 8]}) == ["as the scene says"]
    assert labels({"film.crop": [[0, 0, 8, 8], [8, 8, 8, 8]]})[1] == "crop [8, 8, 8, 8]"


@pytest.mark.parametrize("key", OWN_KEYS)
def test_help_names_every_key_of_a_study(key: str) -> None:
    assert sum(line.startswith(f"  {key}=") for line in HELP.splitlines()) == 1


def test_keys_of_the_scene_are_axes(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "scene: cornell_box\nsampler: [sobol, independent]\n"
        "overrides: {camera.fov: '20,40', materials.red.reflectance: [0, 0, 1], ~shapes.tall_box: ~}\n"
    )
    words, changes = parse_study(
        [f"study={tmp_path}/s.yaml", "materials.red.reflectance=.2,[0,1,0]", "+lights.sky={type: constant}"]
    )
    raw, file = raw_study(words, changes)
    variants = study_of(raw, file).variants
    assert [variant.label for variant in variants[:5]] == [
        "sobol, fov 20, reflectance 0.2", "sobol, fov 20, reflectance [0, 1, 0]", "sobol, fov 40, reflectance 0.2",
        "sobol, fov 40, reflectance [0, 1, 0]", "independent, fov 20, reflectance 0.2",
    ]  # fmt: skip
    assert len(variants) == 8 and variants[1].settings == {"sampler": "sobol"} and variants[1].changes == {
        "camera.fov": 20, "materials.red.reflectance": [0, 1, 0], "~shapes.tall_box": None, "+lights.sky": {"type": "constant"},
    }  # fmt: skip
    raw["reference"] = "r.exr"
    with pytest.raises(SceneError, match=r"camera\.fov: expected one value where reference= is a file"):
        study_of(raw, file)
    for text, line in (("[1]", "overrides: expected a mapping"), ("{camera.fov: '1,1'}", "a list of different values")):
        (tmp_path / "t.yaml").write_text(f"scene: cornell_box\noverrides: {text}\n")
        with pytest.raises(SceneError, match=line):
            study_of(*raw_study({"study": f"{tmp_path}/t.yaml"}))


def test_settings_become_blocks() -> None:
    study = study_of(
        {
            "scene": "cornell_box",
            "integrator": ["path", "direct"],
            "film": {"filter": {"type": "gaussian", "stddev": 0.4}, "width": [8, 16]},
            "render.threads": 1,
            "reference": {"spp": 64, "integrator.max_depth": -1},
        }
    )
    assert len(study.variants) == 4
    last = study.overrides(study.variants[-1])
    assert last["integrator"] == {"type": "direct"} and last["render"] == {"threads": 1}
    assert last["film"] == {"filter": {"type": "gaussian", "stddev": 0.4}, "width": 16}
    reference_overrides = study.reference_overrides(study.variants[-1])
    assert reference_overrides["film"] == last["film"], "the reference is of the same picture"
    assert reference_overrides["integrator"] == {"clamp": None, "max_depth": -1}, "and of the scene's own integrator"
    assert (study.reference.spp, study.reference.seeds) == (64, 8)
    assert study_of({"scene": "cornell_box", "spp": [1, 5]}).reference.spp == 20


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"scene": []}, "scene: expected the name of a scene"),
    ({"scene": ["a", "a"]}, "scene: expected"),
    ({"spp": [4, 4]}, "spp: expected numbers of samples a pixel that grow"),
    ({"spp": 4}, "spp: expected a list of two or more"),
    ({"seeds": 1}, "seeds: expected a whole number 2..1000, got 1"),
    ({"seed": -1}, "seed: expected"),
    ({"metrics": ["psnr", "mse"]}, "metrics: expected a list whose first is an error"),
    ({"metrics": ["mse", "nice"]}, "metrics: expected a list of different ones of relmse"),
    ({"target": [0]}, "target: expected errors > 0"),
    ({"sampler": []}, "sampler: expected a list of different values"),
    ({"sampler": ["sobol", "sobol"]}, "sampler: expected a list of different values"),
    ({"smapler": "sobol"}, "smapler: expected a known key of a study"),
    ({"render.spp": 4}, r"render.spp: expected spp=\[...\]"),
    ({"render": {"seed": 4}}, "render.seed: expected seed="),
    ({"integrator": ["path", {"type": "path"}]}, "integrator: expected settings that differ"),
    ({"extra": [{"name": "x", "seconds": 1}]}, "extra.0: expected a list of {name, seconds, file}"),
    ({"extra": [{"name": "x", "seconds": 0, "file": "f"}]}, "extra.0.seconds: expected seconds > 0"),
    ({"extra": [{"name": "x", "seconds": 1, "file": "f", "scene": "y"}]}, "extra.0.scene: expected one of cornell_box"),
    (
        {"extra": [{"name": "as the scene says", "seconds": 1, "file": "f"}]},
        "extra.0.name: expected a name that no curve",
    ),
    ({"reference": {"file": "a.exr", "spp": 4}}, "reference.spp: expected nothing where reference.file"),
    ({"reference": {"file": {"other": "a.exr"}}}, "reference.file: expected a file for each of cornell_box"),
    ({"reference": {"seeds": 1}}, "reference.seeds: expected a whole number 2..1000"),
    ({"reference": {"sampler": ["sobol", "zsobol"]}}, "reference.sampler: expected one value"),
    ({"reference": {"light": 1}}, "light: expected a known key of a study"),
]


@pytest.mark.parametrize(("raw", "line"), WRONG, ids=[line[:40] for _, line in WRONG])
def test_what_is_wrong_is_named(raw: dict[str, Any], line: str) -> None:
    with pytest.raises(SceneError, match=f"^{line}") as caught:
        study_of({"scene": "cornell_box", **raw})
    assert "\n" not in str(caught.value)


def test_a_group_is_a_file_and_no_path() -> None:
    study = study_of({"scene": "cornell_box", "sampler": ["sobol", "../scene/cornell_box"]})
    with pytest.raises(SceneError, match="sampler: expected one of default, hammersley"):
        study.overrides(study.variants[1])


def test_files_of_a_study_file_start_at_its_folder(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text(
        "scene: [a.yaml, cornell_box]\nreference: {file: {a.yaml: r.exr}}\nextra: [{name: x, seconds: 1, file: e.exr}]\n"
    )
    raw, path = read_study(str(tmp_path / "s.yaml"))
    assert path == str(tmp_path / "s.yaml")
    assert raw["scene"] == [str(tmp_path / "a.yaml"), "cornell_box"]
    assert raw["extra"][0]["file"] == str(tmp_path / "e.exr")
    assert raw["reference"]["file"] == {str(tmp_path / "a.yaml"): str(tmp_path / "r.exr")}
    with pytest.raises(SceneError, match="study: expected one of samplers, or a path ending in .yaml, got 'nope'"):
        read_study("nope")
    with pytest.raises(SceneError, match="study: expected a study file that is there"):
        read_study(str(tmp_path / "none.yaml"))
    (tmp_path / "l.yaml").write_text("[1, 2]\n")
    with pytest.raises(SceneError, match="study: expected a mapping"):
        read_study(str(tmp_path / "l.yaml"))


def test_words_win_over_the_file_and_names_are_kept_as_written(tmp_path: Path) -> None:
    (tmp_path / "s.yaml").write_text("scene: cornell_box\nspp: [1, 2]\nreference: {spp: 8, seeds: 2}\n")
    words, _ = parse_study(
        [f"study={tmp_path}/s.yaml", "spp=[2,4]", "reference.spp=16", "integrator.clamp=[null,1e-1]"]
    )
    raw, _ = raw_study(words)
    assert raw["spp"] == [2, 4] and raw["reference"] == {"spp": 16, "seeds": 2}
    assert raw["integrator.clamp"] == [None, 0.1]
    raw, _ = raw_study(*parse_study(["scene=[a b.yaml,c]", "reference=a [1]: b.exr"]))
    assert raw["scene"] == ["a b.yaml", "c"] and raw["reference"] == "a [1]: b.exr"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--multirun"], "takes lists without it"),
        (["--cfg"], "unknown option"),
        (["scene"], "expected key=value"),
        (["scene=a", "scene=b"], "given twice"),
        (["scene="], "expected a value"),
        (["film._target_=x"], "expected key=value"),
    ],
)
def test_words_that_are_none(words: list[str], line: str) -> None:
    with pytest.raises(UsageError, match=line):
        parse_study(words)
