"""`torchpt convert`: the YAML file renders what the XML does, to the bit; words and errors."""

from __future__ import annotations

import json
import warnings
from pathlib import Path

import pytest
import torch
from mitsuba_corpus import EXACT, NEAREST, write_assets

import torchpt
from torchpt.cli.main import main

Captured = pytest.CaptureFixture[str]


@pytest.fixture
def corpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_assets(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "name", ["obj_flipped", "envmap", "sunsky", "serialized", "references", "instances", "mask_texture", "crop"]
)
def test_the_picture_is_the_same_to_the_bit(corpus: Path, capsys: Captured, name: str) -> None:
    (corpus / "in").mkdir()
    write_assets(corpus / "in")
    (corpus / "in" / "a.xml").write_text(EXACT[name])
    assert main(["convert", "in/a.xml", "b.yaml"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["out"] == "b.yaml" and len(told["meshes"]) == (name == "obj_flipped")
    a, b = (torchpt.render(torchpt.load(file), compile="off", spp=2) for file in ("in/a.xml", "b.yaml"))
    assert torch.equal(a, b) and float(a.mean()) > 0.0


def test_warnings_are_printed_and_words_are_heard(corpus: Path, capsys: Captured) -> None:
    (corpus / "a.xml").write_text(NEAREST["coating"][0].replace('value="16"', 'value="$n"'))
    assert main(["convert", "a.xml", "a.yaml", "scene_params={n: 5}", "camera.fov=25"]) == 0
    assert 'torchpt: warning: a.xml:12: bsdf "coating" becomes plastic' in capsys.readouterr().err
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = torchpt.load("a.yaml")
    assert scene.description.render["spp"] == 5 and scene.description.camera["fov"] == 25.0


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["a.xml"], "expected two files"),
        (["a.xml", "b.txt"], "ends in .yaml"),
        (["none.xml", "b.yaml"], "No such file"),
        (["a.xml", "b.yaml", "import.strict=true"], "import.strict"),
        (["a.xml", "b.yaml", "import.strict=true,false"], "one value"),
        (["a.xml", "b.yaml", "--fast"], "unknown option"),
        (["a.xml", "none/in/b.yaml"], "cannot be written"),
    ],
)
def test_errors_are_one_line(corpus: Path, capsys: Captured, words: list[str], problem: str) -> None:
    (corpus / "a.xml").write_text(NEAREST["coating"][0])
    assert main(["convert", *words]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning" not in line]
    assert len(lines) == 1 and problem in lines[0]
    assert not (corpus / "b.yaml").exists()


def test_other_commands_open_xml(corpus: Path, capsys: Captured) -> None:
    (corpus / "a.xml").write_text(NEAREST["coating"][0])
    assert main(["info", "scene=a.xml", "scene_params={}"]) == 0
    captured = capsys.readouterr()
    assert ("becomes plastic" in captured.err and "sphere_2" in captured.out) or "shapes" in captured.out
    assert main(["info", "scene=a.xml", "import.strict=true"]) == 2
    assert "line 12" in capsys.readouterr().err
