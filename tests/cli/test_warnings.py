"""Warnings about a scene: one line each on stderr, and none where an error takes the line."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchpt.cli.main import main

from .conftest import SCENE, Renderer

SHINY = SCENE + "materials: {a: {type: blinn_phong, specular: 1}, b: {type: phong, diffuse: 1}, c: {type: diffuse}}\n"


@pytest.mark.parametrize("words", [["render", "out=a.png"], ["info"], ["info", "--json"]])
def test_one_line_each(words: list[str], folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "s.yaml").write_text(SHINY)
    assert main([words[0], "scene=s.yaml", *words[1:]]) == 0
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if "warning" in line]
    assert [line.split(": ")[:4] for line in lines] == [
        ["torchpt", "warning", "s.yaml", "materials.a"],
        ["torchpt", "warning", "s.yaml", "materials.b"],
    ]
    assert "warning" not in captured.out


@pytest.mark.parametrize("words", [["film.width=0"], ["out=nowhere/a.png"]])
def test_an_error_is_still_one_line(
    words: list[str], folder: Path, renderer: Renderer, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "s.yaml").write_text(SHINY)
    assert main(["render", "scene=s.yaml", *words]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
