"""`torchpt render ... debug.pixel=[x,y] debug.sample=k`, and what a render says of samples that are not finite."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from few import few

from torchpt.cli.main import main

BALL = """\
camera: {origin: [0, 0, -4], target: [0, 0, 0]}
materials: {white: {type: diffuse}}
shapes: {ball: {type: sphere, material: white}}
film: {width: 16, height: 12, filter: box}
render: {spp: 4, compile: off}
"""
SUN = BALL + "lights: {sun: {type: directional, direction: [0, 0, 1], irradiance: 2}}\n"
NEAR = BALL + "lights: {near: {type: point, position: [0, 0, -1.01], intensity: 3.0e+38}}\n"

FILM, SAMPLES = "the film of 16 x 12 pixels, counted from 0", "a whole number from 0 to 3, as render.spp is 4"

Captured = pytest.CaptureFixture[str]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sun.yaml").write_text(SUN)
    (tmp_path / "near.yaml").write_text(NEAR)
    return tmp_path


def test_a_path_as_text(place: Path, capfd: Captured) -> None:
    assert main(["render", "scene=sun.yaml", "debug.pixel=[8,6]", "debug.sample=1"]) == 0
    said = capfd.readouterr()
    lines = said.out.splitlines()
    assert sorted(os.listdir(place)) == ["near.yaml", "sun.yaml"]  # no picture
    assert lines[0] == "scene sun, pixel (8, 6), sample 1, seed 0"
    assert lines[1].startswith("camera at (0, 0, -4), looking along (")
    assert lines[2] == "1  ball, sphere 0, material white (diffuse)"
    words = [line.split()[0] for line in lines[3:]]
    rows = ["position", "normal", "wo", "light", "scattered", "throughput", "radiance"]
    assert words == [*rows, "2", "radiance", "ended:", "radiance"]
    assert "   light       sun: wi (0, 0, -1), pdf inf (a delta), " in said.out and "visible 1, " in said.out
    assert "2  escaped" in lines and "ended: escaped" in lines


def test_a_path_as_json(place: Path, capfd: Captured) -> None:
    words = ["render", "scene=sun.yaml", "debug.pixel=[8,6]", "render.spp=1"]
    assert main([*words, "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["pixel"] == [8, 6] and told["sample"] == 0 and told["ended"] == "escaped"
    (first, last) = told["vertices"]
    assert first["shape"] == "ball" and first["material"] == "white" and first["light"]["pdf"] == "inf"
    assert first["radiance"] == told["radiance"] == told["value"] and last["position"] is None
    assert main([*words]) == 0
    shown = [
        float(x) for x in capfd.readouterr().out.splitlines()[-1].removeprefix("radiance (").rstrip(")").split(",")
    ]
    assert shown == pytest.approx(told["radiance"], rel=1e-8)


def test_hydras_words_lead_to_the_same_path(place: Path, capfd: Captured) -> None:
    for words in (["sampler=sobol"], ["++sampler.type=sobol"]):  # the second is not plain
        assert main(["render", "scene=sun.yaml", "debug.pixel=[8,6]", *words]) == 0
    out = capfd.readouterr().out.splitlines()
    assert out[: len(out) // 2] == out[len(out) // 2 :]


@pytest.mark.parametrize(
    ("words", "line"),
    few([
        (["debug.pixel=[16,0]"], f"debug.pixel: expected a pixel [x,y] of {FILM}, got [16, 0]"),
        (["debug.pixel=[1]"], "debug.pixel: expected [x,y], two whole numbers from 0, got '[1]'"),
        (["debug.pixel=[-1,0]"], "debug.pixel: expected [x,y], two whole numbers from 0, got '[-1,0]'"),
        (["debug.pixel="], "debug.pixel: expected a name, got nothing"),
        (["debug.pixel=[1,1]", "debug.pixel=[2,1]"], "debug.pixel: given twice, as '[1,1]' and '[2,1]'"),
        (["debug.pixel=[1,1]", "debug.sample=4"], f"debug.sample: expected {SAMPLES}, got 4"),
        (["debug.pixel=[1,1]", "debug.sample=-1"], "debug.sample: expected a whole number from 0, got '-1'"),
        (["debug.sample=1"], "debug.sample: expected debug.pixel=[x,y] beside it, whose sample it is"),
        (["debug.pixels=[1,1]"], "debug.pixels: unknown key; known: debug.pixel, debug.sample"),
        (["debug.pixel=[1,1]", "out=a.png"], "out: no picture is rendered where debug.pixel is given"),
        (
            ["debug.pixel=[1,1]", "integrator=aov"],
            "integrator.type: expected one that follows paths (path, direct, bdpt) beside debug.pixel, got 'aov'",
        ),
    ], 6),
)  # fmt: skip
def test_what_is_wrong_is_told_in_a_line(place: Path, capfd: Captured, words: list[str], line: str) -> None:
    assert main(["render", "scene=sun.yaml", *words]) == 2
    said = capfd.readouterr()
    assert said.err == f"torchpt: {line}\n" and said.out == ""


@pytest.mark.parametrize("command", ["info", "orbit"])
def test_other_commands_have_no_paths(place: Path, capfd: Captured, command: str) -> None:
    assert main([command, "scene=sun.yaml", "debug.pixel=[1,1]"]) == 2
    assert capfd.readouterr().err.startswith("torchpt: debug.pixel: ")


def test_a_render_tells_the_causes(place: Path, capfd: Captured) -> None:
    assert main(["render", "scene=near.yaml", "out=a.png", "render.pilots=false"]) == 0
    said = capfd.readouterr()
    facts = json.loads(said.out.splitlines()[-1])
    count = facts["nonfinite_samples"]
    assert count > 0 and facts["nonfinite_causes"] == {"infinite light": count}
    assert said.err.splitlines()[-1] == (
        f"torchpt: warning: {count} samples are not finite and count as black ({count} infinite light); the first is "
        f"{facts['nonfinite_first']}; debug.pixel=[x,y] debug.sample=k prints a path"
    )
    found = re.search(r"sample (\d+) of pixel \((\d+), (\d+)\)", said.err)
    assert found is not None
    sample, x, y = found.groups()
    assert main(["render", "scene=near.yaml", f"debug.pixel=[{x},{y}]", f"debug.sample={sample}", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert "inf" in told["radiance"] and told["value"] == [0.0, 0.0, 0.0]


def test_strict_ends_in_a_line(place: Path, capfd: Captured) -> None:
    assert main(["render", "scene=near.yaml", "integrator.strict=true", "integrator.clamp=3"]) == 2
    said = capfd.readouterr().err.splitlines()[-1]
    assert said.startswith("torchpt: integrator.strict: sample ") and "Traceback" not in said
    assert said.endswith("is not finite: infinite light at depth 1 (shape ball, material white)")


def test_a_healthy_render_says_nothing(place: Path, capfd: Captured) -> None:
    assert main(["render", "scene=sun.yaml", "out=a.png"]) == 0
    said = capfd.readouterr()
    assert "warning" not in said.err and "nonfinite_causes" not in said.out
