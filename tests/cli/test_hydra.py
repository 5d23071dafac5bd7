from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
import yaml

from torchpt.cli import GROUPS, main
from torchpt.paths import configs
from torchpt.settings import FILTERS, INTEGRATORS, SAMPLERS, Film, Render
from torchpt.spec import not_built

from .conftest import Renderer


def test_cfg_job_prints_the_composed_settings(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--cfg", "job", "scene=s.yaml", "out=x y=[z].exr", "integrator=direct", "render.spp=7"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert set(shown) == set(GROUPS)
    assert shown["integrator"]["type"] == "direct" and shown["render"]["spp"] == 7 and shown["film"]["width"] is None
    assert main(["render", "--cfg=job", "--package", "film"]) == 0
    assert "width: null" in capsys.readouterr().out
    assert os.listdir(folder) == ["s.yaml"]


def test_group_files_hide_nothing_and_name_every_key() -> None:
    later = not_built.KEYS
    known = {
        "film": set(Film.model_fields),
        "integrator": {name for model in INTEGRATORS.values() for name in model.model_fields},
        "sampler": {name for model in SAMPLERS.values() for name in model.model_fields} | set(later.get("sampler", ())),
        "render": set(Render.model_fields) | set(later.get("render", ())),
    }
    for group, keys in known.items():
        for path in (configs() / group).glob("*.yaml"):
            block = yaml.safe_load(path.read_text())
            assert set(block) == keys, path
            filters = {name for model in FILTERS.values() for name in model.model_fields}
            assert set(block.pop("filter", {}) or {}) in (set(), filters), path
            values = {key: value for key, value in block.items() if value is not None}
            assert values == ({} if path.stem == "default" else {"type": path.stem}), path
    assert {path.stem for path in (configs() / "integrator").glob("*.yaml")} == {*INTEGRATORS, "default"}
    assert {path.stem for path in (configs() / "sampler").glob("*.yaml")} == {*SAMPLERS, "default"}


def test_every_file_in_configs_opens_with_its_command() -> None:
    for path in configs().rglob("*.yaml"):
        assert "torchpt render " in path.read_text().splitlines()[0], path


def test_no_litter_even_in_a_folder_that_cannot_be_written(folder: Path, renderer: Renderer, tmp_path: Path) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for words in ([], ["-m", "render.spp=1,2"]):
        assert main(["render", "scene=s.yaml", f"out={pictures}/a.png", *words]) == 0
    assert sorted(os.listdir(folder)) == ["pictures", "s.yaml"]
    assert sorted(os.listdir(pictures)) == ["a.png", "a_0.png", "a_1.png"]


def test_the_environment_is_left_alone(
    folder: Path, renderer: Renderer, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")
    before = dict(os.environ)
    assert main(["render", "scene=s.yaml"]) == 0
    assert main(["render", "scene=s.yaml", "film.foo=3"]) == 2
    assert dict(os.environ) == before


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    for words, says in [
        (["--help"], "torchpt render"),
        (["render", "-h"], "--multirun"),
        (["info", "--help"], "--json"),
    ]:
        assert main(words) == 0
        captured = capsys.readouterr()
        assert says in captured.out and "cornell_box" in captured.out and captured.err == ""
        assert max(map(len, captured.out.splitlines())) <= 150
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("torchpt 0.")


def test_info(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "scene=s.yaml"]) == 0
    plain = capsys.readouterr()
    assert plain.err == "" and "\x1b" not in plain.out and len(plain.out.splitlines()) > 3
    assert main(["info", "scene=s.yaml", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert isinstance(facts, dict) and all(f"{key}:" in plain.out for key in facts)
    assert os.listdir(folder) == ["s.yaml"]
