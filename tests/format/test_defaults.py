"""Scenes that consist of several files: `defaults`, in order, the scene's own keys last."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

import torchpt
from torchpt import SceneError
from torchpt.scene.fingerprint import fingerprint
from torchpt.scene.formats.compose import MAX_FILES, MAX_LEVELS
from torchpt.scene.formats.description import read_description

BASE = """\
camera: {origin: [0, 1, 4], target: [0, 0, 0], fov: 40}
film: {width: 24, height: 16, filter: {type: gaussian, stddev: 0.4}}
integrator: {type: path, max_depth: 5}
materials:
  white: {type: diffuse, reflectance: [0.7, 0.7, 0.7]}
  shiny: {type: conductor, reflectance: 0.9}
shapes:
  floor: {type: rectangle, material: white, transform: [{rotate: {axis: [1, 0, 0], angle: -90}}, {scale: 3}]}
  ball: {type: sphere, center: [0, 1, 0], radius: 0.5, material: shiny}
  block: {type: cube, material: white, transform: [{scale: 0.3}]}
lights: {sky: {type: constant, radiance: 0.5}}
"""
STUDIO = """\
# A part: no scene by itself.
lights:
  sky: ~
  key: {type: point, position: [2, 3, 2], intensity: 20}
materials: {white: {reflectance: 0.4}}
"""
OWN = """\
defaults: [base, lights/studio]
film: {width: 12}
integrator: direct
materials: {shiny: {type: plastic}}
shapes:
  block: ~
  ball: {radius: 0.8}
  cone: {type: cone, apex: [1, 1, 0], material: shiny}
"""
WRITTEN = """\
camera: {origin: [0, 1, 4], target: [0, 0, 0], fov: 40}
film: {width: 12, height: 8, filter: {type: gaussian, stddev: 0.4}}
integrator: {type: direct}
materials:
  white: {type: diffuse, reflectance: 0.4}
  shiny: {type: plastic}
shapes:
  floor: {type: rectangle, material: white, transform: [{rotate: {axis: [1, 0, 0], angle: -90}}, {scale: 3}]}
  ball: {type: sphere, center: [0, 1, 0], radius: 0.8, material: shiny}
  cone: {type: cone, apex: [1, 1, 0], material: shiny}
lights: {key: {type: point, position: [2, 3, 2], intensity: 20}}
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lights").mkdir()
    for name, text in (("base", BASE), ("lights/studio", STUDIO), ("own", OWN)):
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


def test_files_are_merged_in_order_and_own_keys_last(place: Path) -> None:
    composed, written = torchpt.load("own.yaml", "cpu"), torchpt.load(WRITTEN, "cpu")
    for block in ("camera", "film", "integrator", "materials", "shapes", "lights"):
        assert getattr(composed.description, block) == getattr(written.description, block), block
    assert list(composed.description.shapes) == ["floor", "ball", "cone"]
    assert fingerprint(composed) == fingerprint(written)
    assert torch.equal(torchpt.render(composed, spp=4, compile="off"), torchpt.render(written, spp=4, compile="off"))


def test_a_mapping_and_text_name_files_too(place: Path) -> None:
    own: dict[str, Any] = {"defaults": "base.yaml", "shapes": {"ball": None}}
    assert list(read_description(own).shapes) == ["floor", "block"]
    assert list(read_description("defaults: [base]\nlights: ~\n").lights) == []
    found = torchpt.load(
        {"defaults": ["cornell_box"], "camera": {"fov": torch.tensor(30.0, requires_grad=True)}}, "cpu"
    )
    assert found.params["camera.fov"].requires_grad and len(found.description.shapes) == 8


def test_a_file_extends_the_one_that_ships_by_its_name(place: Path) -> None:
    (place / "cornell_box.yaml").write_text("defaults: [cornell_box]\ncamera: {fov: 20}\n")
    found = read_description("cornell_box.yaml")
    assert found.camera["fov"] == 20 and "tall_box" in found.shapes


def test_paths_start_at_the_file_that_they_stand_in(place: Path) -> None:
    for folder in ("a", "b"):
        (place / folder).mkdir()
    (place / "a" / "part.yaml").write_text(
        "textures: {t: {type: image, path: [$TORCHPT_ASSETS/none.png, t.png]}}\nshapes: {m: {type: mesh, path: ../m.ply}}\n"
    )
    (place / "b" / "scene.yaml").write_text(
        "defaults: [../base, ../a/part.yaml]\nshapes: {n: {type: mesh, path: n.ply, material: {type: diffuse,"
        " reflectance: {type: image, path: u.png}}}}\n"
    )
    found = read_description("b/scene.yaml")
    assert found.textures["t"]["path"] == ("$TORCHPT_ASSETS/none.png", str(place / "a" / "t.png"))
    assert found.shapes["m"]["path"] == (str(place / "m.ply"),) and found.shapes["n"]["path"] == ("n.ply",)
    with pytest.raises(torchpt.AssetError, match=r"m\.ply: no such file, named by shapes\.m\.path of a/part\.yaml"):
        torchpt.load("b/scene.yaml", "cpu", overrides={"~shapes.n": None})
    with pytest.raises(torchpt.AssetError, match=r"n\.ply: no such file, named by shapes\.n\.path of b/scene\.yaml"):
        torchpt.load("b/scene.yaml", "cpu", overrides={"~shapes.m": None})


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{defaults: [bas]}", r"^x\.yaml: defaults\.0: expected a file that is there: .*did you mean base\?\), got 'bas'"),
        ("{defaults: [base, none.yaml]}", r"x\.yaml: defaults\.1: expected a file that is there"),
        ("{defaults: [x.yaml]}", r"x\.yaml: defaults\.0: expected files that do not name themselves \(x\.yaml -> x\.yaml\)"),
        ("{defaults: [y]}", r"^y\.yaml: defaults\.0: .* do not name themselves \(x\.yaml -> y\.yaml -> x\.yaml\)"),
        ("{defaults: {a: b}}", r"x\.yaml: defaults: expected a list of names"),
        ("{defaults: [base, 3]}", r"x\.yaml: defaults\.1: expected a list of names"),
        ("{defaults: [_self_, base]}", r"x\.yaml: defaults\.0: expected a list of names"),
        ("{defaults: [/dev/zero.yaml]}", r"x\.yaml: defaults\.0: expected a file that is there"),
        ("{defaults: [base], shapes: {bal: ~}}", r"x\.yaml: shapes\.bal: expected the name of a shape .*did you mean ball\?"),
        ("{defaults: [base], shapes: {ball: {radius: -1}}}", r"^x\.yaml: shapes\.ball\.radius: expected"),
        ("{defaults: [base], materials: {shiny: {glow: 3}}}", r"^x\.yaml: materials\.shiny\.glow: expected a known key"),
        ("{defaults: [base, broken]}", r"^broken\.yaml: materials\.white\.reflectance: expected"),
        ("{defaults: [base, shapeless]}", r"^shapeless\.yaml: shapes\.ball\.radius: expected"),
        ("{defaults: [base, lights/studio], lights: {key: {intensity: -2}}}", r"^x\.yaml: lights\.key\.intensity"),
        ("{defaults: [base, odd]}", r"^odd\.yaml: line 2"),
        ("{defaults: [base, target]}", r"^target\.yaml: camera\._target_: expected no"),
        ("{defaults: [lights/studio]}", r"x\.yaml: camera: expected a camera"),
        ("{defaults: [base], camera: ~}", r"x\.yaml: camera: expected a camera"),
    ],
)  # fmt: skip
def test_what_is_wrong_names_the_file_that_says_it(place: Path, text: str, line: str) -> None:
    for name, other in (
        ("x", text), ("y", "{defaults: [x]}"), ("broken", "{materials: {white: {reflectance: 7}}}"),
        ("shapeless", "{shapes: {ball: {radius: []}}}"), ("odd", "{"), ("target", "{camera: {_target_: os.system}}"),
    ):  # fmt: skip
        (place / f"{name}.yaml").write_text(other)
    with pytest.raises(SceneError, match=line) as caught:
        read_description("x.yaml")
    assert "\n" not in str(caught.value)


def test_depth_and_number_of_files_are_bounded(place: Path) -> None:
    for level in range(MAX_LEVELS + 1):
        (place / f"l{level}.yaml").write_text(f"defaults: [{'base' if level == 0 else f'l{level - 1}'}]\n")
    assert read_description(f"l{MAX_LEVELS - 1}.yaml").camera["fov"] == 40
    with pytest.raises(
        SceneError, match=rf"defaults\.0: expected files that name each other at most {MAX_LEVELS} levels deep"
    ):
        read_description(f"l{MAX_LEVELS}.yaml")
    (place / "wide.yaml").write_text(f"defaults: [{', '.join(['base'] * (MAX_FILES + 1))}]\n")
    with pytest.raises(SceneError, match=f"expected a scene of at most {MAX_FILES} files"):
        read_description("wide.yaml")


def test_overrides_come_last(place: Path) -> None:
    found = read_description(
        "own.yaml", overrides={"shapes.ball.radius": 2, "+lights.sky": {"type": "constant"}, "film.height": 16}
    )
    assert found.shapes["ball"]["radius"] == 2 and list(found.lights) == ["key", "sky"] and found.film["width"] == 24
    with pytest.raises(SceneError, match=r"^shapes\.ball\.radius: expected"):
        read_description("own.yaml", overrides={"shapes.ball.radius": -2})
    with pytest.raises(SceneError, match=r"^shapes\.block: expected the name of a shape"):
        read_description("own.yaml", overrides={"shapes.block.material": "white"})


def test_a_k_in_pixels_keeps_the_film_that_it_is_of(place: Path) -> None:
    camera = {"R": [[1, 0, 0], [0, -1, 0], [0, 0, -1]], "t": [0, 0, 4], "K": [[30, 0, 12], [0, 30, 8], [0, 0, 1]]}
    scene: dict[str, Any] = {"camera": camera, "film": {"width": 24, "height": 16}}
    assert read_description(scene, overrides={"film.width": 48}).camera["fov"] == read_description(scene).camera["fov"]


def test_energy_warnings_name_the_file(place: Path) -> None:
    (place / "bright.yaml").write_text("materials: {m: {type: phong, diffuse: 0.9, specular: 0.9}}\n")
    (place / "x.yaml").write_text("defaults: [base, bright]\nfilm: {width: 8}\n")
    with pytest.warns(torchpt.EnergyWarning, match=r"bright\.yaml: materials\.m"):
        read_description("x.yaml")
