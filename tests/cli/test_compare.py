"""`torchpt compare`: words, files, what is printed, and the map that is written."""

from __future__ import annotations

import json
import math
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchpt.cli.main import main
from torchpt.images import read_image, read_layers, write_image
from torchpt.images.comparison import DisplayTransform
from torchpt.images.comparison import compare as measure
from torchpt.images.false_colour import false_colour
from torchpt.images.metrics import METRICS, error_map

DRAW = torch.Generator().manual_seed(3)
B = 2.0 * torch.rand((14, 18, 3), generator=DRAW)
A = B * (1.0 + 0.3 * torch.randn(B.shape, generator=DRAW)).clamp(min=0.1)
Captured = pytest.CaptureFixture[str]


def layers_of(image: Tensor) -> dict[str, Tensor]:
    return {"albedo": image / 4, "normal": image - 1, "depth": image[..., 0] * 100, "uv": image[..., :2]}


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with two pictures and their layers."""
    monkeypatch.chdir(tmp_path)
    write_image("a.exr", A, layers_of(A))
    write_image("b.exr", B, layers_of(B))
    return tmp_path


def layers_alone(path: Path, **layers: Tensor) -> None:
    """An EXR of layers ``(H, W, 3)`` and no picture."""
    import OpenImageIO as oiio

    values = torch.cat(list(layers.values()), dim=-1)
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], "float")
    spec.channelnames = [f"{layer}.{c}" for layer in layers for c in "RGB"]
    file: Any = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec) and file.write_image(values.numpy()) and file.close()


def facts(capfd: Captured, *words: str) -> dict[str, Any]:
    assert main(["compare", *words, "--json"]) == 0
    captured = capfd.readouterr()
    assert captured.err == "" and len(captured.out.splitlines()) == 1
    return json.loads(captured.out)


def test_json_holds_every_measure(pair: Path, capfd: Captured) -> None:
    told = facts(capfd, "a.exr", "b.exr")
    found = measure(A, B)
    assert told["metrics"] == pytest.approx({k: v if math.isfinite(v) else None for k, v in found.metrics.items()})
    assert list(told["metrics"]) == list(METRICS) and told["reasons"] == found.reasons
    assert told["mean"]["test"] == pytest.approx(A.mean((0, 1)).tolist(), rel=1e-5)
    assert told["mean"]["reference"] == pytest.approx(B.mean((0, 1)).tolist(), rel=1e-5)
    assert told["mean_ratio"] == pytest.approx(float(A.mean() / B.mean()), rel=1e-5)
    assert told["nonfinite_pixels"] == {"test": 0, "reference": 0}
    assert (told["test"], told["reference"], told["layer"]) == ("a.exr", "b.exr", "image")
    assert (told["width"], told["height"], told["channels"]) == (18, 14, 3)
    assert told["display"] == {"exposure": 0.0, "tonemap": "none", "gamma": "srgb"} and "map" not in told


def test_the_table_says_the_same(pair: Path, capfd: Captured) -> None:
    assert main(["compare", "a.exr", "b.exr", "map=e.png"]) == 0
    captured = capfd.readouterr()
    rows: dict[str, list[str]] = {}
    for words in map(str.split, captured.out.splitlines()):
        rows.setdefault(*(words[0], words[1:]) if words else ("", []))
    found = measure(A, B)
    for name, value in found.metrics.items():
        assert rows[name][0] == (f"{value:.6g}" if math.isfinite(value) else "none")
    assert rows["test"] == ["a.exr"] and rows["reference"] == ["b.exr"] and "18 x 14 pixels" in captured.out
    assert rows["mean"] == [f"{float(A.double().mean()):.6g}", f"{float(B.double().mean()):.6g}", f"{found.ratio:.6g}"]
    assert "psnr, ssim: of what a screen shows; exposure 0, tonemap none, gamma srgb" in captured.out
    assert rows["map:"][0] == "relmse," and "in e.png" in captured.out and captured.err == ""


def test_how_a_screen_shows_it(pair: Path, capfd: Captured) -> None:
    told = facts(capfd, "a.exr", "b.exr", "exposure=-1", "tonemap=reinhard", "gamma=0.5")
    assert told["display"] == {"exposure": -1.0, "tonemap": "reinhard", "gamma": 0.5}
    found = measure(A, B, DisplayTransform(-1.0, "reinhard", 0.5))
    assert told["metrics"]["psnr"] == pytest.approx(found.metrics["psnr"])
    assert found.metrics["psnr"] != pytest.approx(measure(A, B).metrics["psnr"], rel=1e-3)


@pytest.mark.parametrize(("layer", "colours"), [("albedo", True), ("normal", False), ("depth", False), ("uv", False)])
def test_layers(pair: Path, capfd: Captured, layer: str, colours: bool) -> None:
    told = facts(capfd, "a.exr", "b.exr", f"layer={layer}")
    one, two = (read_layers(name)[layer] for name in ("a.exr", "b.exr"))
    found = measure(one, two, colours=colours)
    assert told["metrics"]["relmse"] == pytest.approx(found.metrics["relmse"])
    assert told["layer"] == layer and told["channels"] == one.shape[2]
    assert (told["metrics"]["psnr"] is not None) == colours == ("display" in told)


def test_a_file_of_one_layer_needs_no_name(pair: Path, capfd: Captured) -> None:
    for name, picture in (("one.exr", A), ("two.exr", B)):
        layers_alone(pair / name, Combined=picture)
    told = facts(capfd, "one.exr", "two.exr")
    assert told["layer"] == "Combined" and told["metrics"]["psnr"] == pytest.approx(measure(A, B).metrics["psnr"])


@pytest.mark.parametrize("metric", ["relmse", "mse", "smape", "ssim"])
def test_a_map_of_numbers(pair: Path, capfd: Captured, metric: str) -> None:
    told = facts(capfd, "a.exr", "b.exr", "map=e.exr", f"metric={metric}")["map"]
    written = read_layers("e.exr")["image"]
    seen = (DisplayTransform().apply(A), DisplayTransform().apply(B)) if metric == "ssim" else (A, B)
    errors = error_map(metric, *seen)
    assert written.shape == (14, 18, 1) and torch.allclose(written[..., 0], errors.float(), rtol=1e-6)
    assert told == {"file": "e.exr", "metric": metric, "largest": pytest.approx(float(errors.max()))}
    assert sorted(os.listdir(pair)) == ["a.exr", "b.exr", "e.exr"]  # and nothing half written


@pytest.mark.parametrize("words", [(), ("range=0.25",), ("metric=smape",)])
def test_a_map_of_colours(pair: Path, capfd: Captured, words: tuple[str, ...]) -> None:
    told = facts(capfd, "a.exr", "b.exr", "map=e.png", *words)["map"]
    errors = error_map(told["metric"], A, B)
    below, top = told["range"]
    assert below == 0.0
    if "range=0.25" in words:
        assert top == 0.25
    elif "metric=smape" in words:
        assert top == 1.0
    else:
        assert int((errors > top * (1 + 1e-12)).sum()) == 2  # of 252 pixels, 1 %
    stored = read_image("e.png", linear=True)
    assert float((stored - false_colour(errors, top)).abs().max()) <= 0.5 / 255 + 1e-6


def test_a_map_of_equal_pictures_is_black(pair: Path, capfd: Captured) -> None:
    told = facts(capfd, "a.exr", "a.exr", "map=e.png")
    assert told["map"] == {"file": "e.png", "metric": "relmse", "largest": 0.0, "range": [0.0, 1.0]}
    assert float(read_image("e.png", linear=True).max()) < 0.02
    assert told["metrics"]["psnr"] is None and "alike" in told["reasons"]["psnr"]


def test_pixels_that_are_not_finite(pair: Path, capfd: Captured) -> None:
    image = A.clone()
    image[4, 5, 0] = math.nan
    write_image("n.exr", image)
    told = facts(capfd, "n.exr", "b.exr", "map=e.png")
    assert told["nonfinite_pixels"] == {"test": 1, "reference": 0} and told["mean_ratio"] is not None
    assert set(told["metrics"].values()) == {None} and set(told["reasons"]) == set(METRICS)
    assert read_image("e.png", linear=True)[4, 5].tolist() == [0.0, 1.0, 0.0]
    assert main(["compare", "n.exr", "b.exr"]) == 0
    out = capfd.readouterr().out
    assert "relmse, relmse_trimmed, mse, smape, psnr, ssim, flip: a picture holds values that are not finite" in out


def test_a_black_reference(pair: Path, capfd: Captured) -> None:
    write_image("black.exr", torch.zeros_like(B))
    told = facts(capfd, "a.exr", "black.exr")
    assert told["mean_ratio"] is None and told["metrics"]["flip"] is None and told["metrics"]["relmse"] > 0


def test_without_flip_one_line_says_what_to_install(
    pair: Path, capfd: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    assert main(["compare", "a.exr", "b.exr"]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert "flip: needs the package flip-evaluator: pip install '.[compare]' in the checkout of torchpt" in lines
    assert main(["compare", "a.exr", "b.exr", "map=f.png", "metric=flip"]) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and "pip install" in captured.err and not (pair / "f.png").exists()


@pytest.mark.skipif(not find_spec("flip_evaluator"), reason="flip-evaluator is not installed (extra `compare`)")
def test_a_map_of_flip(pair: Path, capfd: Captured) -> None:
    told = facts(capfd, "a.exr", "b.exr", "map=f.exr", "metric=flip")
    assert float(read_layers("f.exr")["image"].mean()) == pytest.approx(told["metrics"]["flip"], rel=1e-5)


def test_alpha_is_in_no_measure_and_is_told(pair: Path, capfd: Captured) -> None:
    for name, image, alpha in (("a4.exr", A, 1.0), ("b4.exr", B, 0.75)):
        write_image(name, torch.cat([image, torch.full((14, 18, 1), alpha)], dim=-1))
    told = facts(capfd, "a4.exr", "b4.exr")
    assert told["channels"] == 4 and told["largest_alpha_difference"] == 0.25
    assert told["metrics"] == pytest.approx(facts(capfd, "a.exr", "b.exr")["metrics"])
    assert main(["compare", "a4.exr", "b4.exr"]) == 0
    assert "alpha is in no measure; its largest difference is 0.25" in capfd.readouterr().out


def test_eight_bits_and_grey(pair: Path, capfd: Captured) -> None:
    write_image("a.png", A)
    write_image("b.png", B)
    told = facts(capfd, "a.png", "b.png")
    assert told["metrics"]["psnr"] == pytest.approx(measure(A, B).metrics["psnr"], rel=0.02)  # what a screen shows
    write_image("a1.exr", A[..., :1])
    write_image("b1.exr", B[..., :1])
    assert facts(capfd, "a1.exr", "b1.exr")["metrics"]["ssim"] is not None


NAMES = ["a b.exr", "x=[1,2].exr", "[bold]red.exr", "{c}.exr", "$HOME 'q'.exr", "film.width=3.exr", "ä.exr"]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_files_hold_whatever_they_like(pair: Path, capfd: Captured, name: str) -> None:
    (pair / "a.exr").rename(name)
    told = facts(capfd, name, "b.exr", f"map=map {name}")
    assert told["test"] == name and told["map"]["file"] == f"map {name}" and (pair / f"map {name}").is_file()
    assert main(["compare", name, "b.exr"]) == 0
    assert f"test       {name}\n" in capfd.readouterr().out


def test_a_name_that_is_no_text(pair: Path, capfd: Captured) -> None:
    write_image("a.png", A)
    name = os.fsdecode(b"\xff.png")
    (pair / "a.png").rename(name)
    assert main(["compare", name, "b.exr"]) == 0
    assert "\\udcff.png" in capfd.readouterr().out
    assert facts(capfd, name, "b.exr")["test"] == name


@pytest.mark.parametrize("name", ["map=a.exr", "--json.exr"])
def test_names_that_look_like_words_of_the_command(pair: Path, capfd: Captured, name: str) -> None:
    (pair / "a.exr").rename(name)
    assert main(["compare", "--json", "--", name, "b.exr"]) == 0
    assert json.loads(capfd.readouterr().out)["test"] == name


def test_a_long_name_stays_in_one_line(pair: Path, capfd: Captured) -> None:
    name = "n" * 200 + ".exr"
    (pair / "a.exr").rename(name)
    assert main(["compare", name, "b.exr"]) == 0
    assert f"test       {name}" in capfd.readouterr().out.splitlines()


def test_help(capfd: Captured) -> None:
    for words in (["--help"], ["-h"], ["a.exr", "--help"]):
        assert main(["compare", *words]) == 0
        assert capfd.readouterr().out.startswith("torchpt compare TEST REFERENCE")


AB = ("a.exr", "b.exr")
BAD = [
    ((), "expected two pictures, torchpt compare TEST REFERENCE, got 0"),
    (("a.exr",), "got 1: a.exr"),
    (("a.exr", "b.exr", "small.exr"), "got 3: a.exr, b.exr, small.exr"),
    (("a.exr", "nowhere.exr"), "nowhere.exr: no such file"),
    (("a.exr", "text.exr"), "text.exr: cannot be read"),
    (("a.exr", "text.txt"), "text.txt: unknown kind of image '.txt'"),
    (("a.exr", "folder.exr"), "folder.exr: is not a file"),
    (("a.exr", "small.exr"), "a.exr: is 18 x 14 pixels, and small.exr is 18 x 13: sizes must agree"),
    (("a.exr", "grey.exr"), "a.exr: has 3 channels, and grey.exr has 1 channel: channels must agree"),
    ((*AB, "layer=bogus"), "a.exr: has no layer 'bogus'; it has image, depth, albedo, normal, uv"),
    (("a.exr", "small.exr", "layer=albedo"), "small.exr: has no layer 'albedo'; it has image"),
    (("a.png", "b.exr", "layer=albedo"), "a.png: has no layer 'albedo'; it has image"),
    (("many.exr", "b.exr"), "many.exr: has no picture among its layers; choose one with layer=; it has one, two"),
    ((*AB, "map=e.png", "metric=psnr"), "metric: expected one of relmse, mse, smape, ssim, flip, got 'psnr'"),
    ((*AB, "map=e.png", "metric=ssim", "layer=depth"), "metric: the layer depth holds no colours"),
    ((*AB, "exposure=1", "layer=normal"), "exposure: the layer normal holds no colours"),
    ((*AB, "metric=mse"), "metric: says what the error map shows, and there is none"),
    ((*AB, "range=1"), "range: says what the error map shows, and there is none"),
    ((*AB, "map=e.exr", "range=1"), "range: an .exr map holds the numbers themselves"),
    ((*AB, "map=e.png", "range=0"), "range: expected a number above 0, got '0'"),
    ((*AB, "map=e.png", "range=nan"), "range: expected a number above 0"),
    ((*AB, "map=e.jpg"), "e.jpg: cannot write the kind '.jpg'; accepted: .exr .png"),
    ((*AB, "map=e"), "e: needs an ending"),
    ((*AB, "map=nowhere/e.png"), "there is no folder"),
    ((*AB, "map=./b.exr"), "./b.exr: is one of the pictures that are compared"),
    ((*AB, "map="), "map: expected a value, got nothing"),
    ((*AB, "map=e.png", "map=f.png"), "map: given twice, as 'e.png' and 'f.png'"),
    ((*AB, "mapp=e.png"), "mapp=e.png: unknown key, and no file of this name; known: map, metric"),
    ((*AB, "exposure=bright"), "exposure: expected a number of stops in -64..64, got 'bright'"),
    ((*AB, "exposure=100"), "exposure: expected a number of stops"),
    ((*AB, "tonemap=nice"), "tonemap: expected one of none, filmic, aces, reinhard, got 'nice'"),
    ((*AB, "gamma=0"), "gamma: expected srgb or an exponent > 0"),
    ((*AB, "--jason"), "--jason: unknown option; known: --json"),
    (("tiny.exr", "tiny.exr", "map=e.png", "metric=ssim"), "e.png: there is no such map: ssim looks through windows"),
]


@pytest.mark.parametrize(("words", "says"), BAD, ids=lambda value: " ".join(value) if isinstance(value, tuple) else "")
def test_bad_input_is_one_line_and_writes_nothing(
    pair: Path, capfd: Captured, words: tuple[str, ...], says: str
) -> None:
    write_image("small.exr", A[:13])
    write_image("tiny.exr", A[:5, :5])
    write_image("grey.exr", A[..., :1])
    write_image("a.png", A)
    (pair / "text.exr").write_text("no picture")
    (pair / "text.txt").write_text("no picture")
    (pair / "folder.exr").mkdir()
    layers_alone(pair / "many.exr", one=A, two=B)
    before = {name: (pair / name).stat().st_mtime_ns for name in os.listdir(pair)}
    assert main(["compare", *words]) == 2
    captured = capfd.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1, captured.err
    assert captured.err.startswith("torchpt: ") and says in captured.err
    assert {name: (pair / name).stat().st_mtime_ns for name in os.listdir(pair)} == before


def test_a_map_replaces_an_old_one_and_follows_links(pair: Path, capfd: Captured) -> None:
    (pair / "old.png").write_text("old")
    (pair / "link.png").symlink_to("old.png")
    facts(capfd, *AB, "map=link.png")
    assert (pair / "link.png").is_symlink() and read_image("old.png").shape == (14, 18, 3)


@pytest.mark.slow
def test_nothing_of_hydra_is_imported(pair: Path) -> None:
    import subprocess

    run = "from torchpt.cli.main import main; main(['compare', 'a.exr', 'b.exr'])"
    code = f"import sys; {run}; assert 'hydra' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL, timeout=120)
