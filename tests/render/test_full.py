"""`torchpt.render(..., full=True)`: a picture with all that is known of it."""

from __future__ import annotations

import re
from base64 import b64decode
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import torchpt
from torchpt.core.errors import OutputError, RenderError, SceneError
from torchpt.images import denoiser

BALL: dict[str, Any] = {
    "camera": {"type": "perspective", "origin": [0, 0, 4], "target": [0, 0, 0], "fov": 40},
    "film": {"width": 24, "height": 16, "filter": "box"},
    "render": {"spp": 8},
    "materials": {"grey": {"type": "diffuse", "reflectance": 0.5}},
    "shapes": {
        "ball": {"type": "sphere", "material": "grey"},
        "lamp": {"type": "sphere", "center": [2, 2, 2], "radius": 0.5, "emission": 5},
    },
    "lights": {"sky": {"type": "constant", "radiance": 0.3}},
}
EVERY = ("alpha", "depth", "normal", "position", "albedo", "uv", "object_id")


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load(BALL, "cpu")


def film(*aovs: str, **more: Any) -> dict[str, Any]:
    return {"aovs": list(aovs), **more}


@pytest.fixture
def halved(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """A denoiser that halves; the layers that it was given."""

    seen: list[tuple[str, ...]] = []

    def half(image: torch.Tensor, **guides: torch.Tensor) -> torch.Tensor:
        assert not image.requires_grad
        seen.append(tuple(guides))
        return 0.5 * image

    monkeypatch.setattr("torchpt.rendering.requests.check_denoiser", lambda: None)
    monkeypatch.setattr("torchpt.images.denoiser.denoise", half)
    return seen


def test_the_picture_is_the_same(scene: torchpt.Scene) -> None:
    image: torch.Tensor = torchpt.render(scene)
    full: torchpt.Rendering = torchpt.render(scene, full=True)  # type checkers know which of the two comes back
    assert type(full) is torchpt.Rendering and torch.equal(full.image, image)
    assert full["rgb"] is full.image and full.layers == {} and full.denoised is None and full.variance is None
    assert (full.spp, full.paths, full.nonfinite_samples, full.complete) == (8, 8 * 24 * 16, 0, True)
    assert full.rays > full.paths and full.relmse is None and full.relmse_interval is None
    assert 0 < full.render_seconds < full.seconds and full.load_seconds == scene.load_seconds > 0


def test_layers_by_name(scene: torchpt.Scene) -> None:
    full = torchpt.render(scene, film=film(*EVERY), full=True)
    assert tuple(full) == full.keys() == ("rgb", *EVERY) and len(full) == 8
    assert {name: value.shape[2] for name, value in dict(full).items()} == {
        **{"rgb": 3, "alpha": 1, "depth": 1, "normal": 3, "position": 3, "albedo": 3, "uv": 2, "object_id": 1}
    }
    assert full["depth"] is full.layers["depth"] and "depth" in full and "variance" not in full
    assert float(full["depth"][8, 12, 0]) == pytest.approx(3.0, abs=0.02) and float(full["depth"][0, 0, 0]) == 0.0
    with pytest.raises(KeyError, match="variance: expected one of rgb, alpha, .*; film.aovs asks for more"):
        full["variance"]


@pytest.mark.parametrize("compiled", ["on", "off"])
@pytest.mark.parametrize(
    "integrator",
    [{"type": "path", "max_depth": 0}, {"type": "path", "max_depth": 1}, {"type": "bdpt", "strategy": "light_paths"}],
)
def test_layers_do_not_depend_on_how_far_paths_go(
    scene: torchpt.Scene, integrator: dict[str, Any], compiled: str
) -> None:
    options: dict[str, Any] = {"film": film("albedo", "depth"), "compile": compiled, "spp": 4, "full": True}
    full, usual = torchpt.render(scene, integrator=integrator, **options), torchpt.render(scene, **options)
    assert usual["albedo"].any()
    assert all(torch.equal(full[name], usual[name]) for name in ("albedo", "depth"))


def test_variance_and_error(scene: torchpt.Scene) -> None:
    spread = torchpt.render(scene, film=film("variance"), full=True)
    assert spread.variance is not None and spread.variance.shape == (16, 24, 3)
    assert spread.relmse is not None and float(spread.variance.mean()) > 0
    known = torchpt.render(scene, pilots=True, full=True)
    assert known.relmse is not None and known.relmse_interval is not None
    low, high = known.relmse_interval
    assert 0 < low < known.relmse < high
    truth = torchpt.metrics.METRICS["relmse"](known.image, torchpt.render(scene, spp=1024, seed=5))
    assert low / 2 < truth < 2 * high
    with pytest.raises(SceneError, match="render.pilots: expected auto, true or false, got 'often'"):
        torchpt.render(scene, pilots="often")


def test_a_tensor_too_ends_by_time_or_error(scene: torchpt.Scene) -> None:
    first = torchpt.render(scene, spp=10**6, target_error=0.05, full=True)
    assert first.stopped_by == "target_error" and first.spp < 4096 and first.complete
    assert torch.equal(torchpt.render(scene, spp=10**6, target_error=0.05), first.image)
    timed = torchpt.render(scene, spp=10**6, time_limit=0.2, full=True)
    assert timed.stopped_by == "time_limit" and timed.spp < 10**6
    with pytest.raises(SceneError, match="render.time_limit"):
        torchpt.render(scene, time_limit=-1.0)


def test_samples_are_counted(scene: torchpt.Scene) -> None:
    even = torchpt.render(scene, film=film("samples"), full=True)["samples"]
    assert even.shape == (16, 24, 1) and bool((even == 8).all())
    pilots = torchpt.render(scene, film=film("samples"), pilots=True, full=True)["samples"]
    assert sorted(pilots.unique().tolist()) == [8, 16] and int((pilots == 16).sum()) == 24  # one of each 4 x 4
    uneven = torchpt.render(scene, film=film("samples"), sampler={"adaptive": True}, spp=64, full=True)
    counts = uneven["samples"]
    assert len(counts.unique()) > 1 and int(counts.mean()) == uneven.spp
    # The sky alone is known after the first round.
    assert float(counts[0, 0, 0]) < float(counts.max())
    with pytest.raises(SceneError, match="no samples where integrator is aov"):
        torchpt.render(scene, film=film("samples"), integrator="aov")


def test_gradients_are_of_the_picture_and_of_first_surfaces(scene: torchpt.Scene) -> None:
    name = "materials.grey.reflectance"
    gradients = []
    for wish in ({}, {"full": True, "film": film("albedo")}):
        colour = scene.params[name].clone().requires_grad_()
        found = torchpt.render(scene, params={name: colour}, spp=2, **wish)
        image = found.image if isinstance(found, torchpt.Rendering) else found
        if isinstance(found, torchpt.Rendering):
            assert found["albedo"].requires_grad and found.spp == 2
            assert "requires_grad" not in repr(found) and len(found.summary()["mean"]) == 3
            assert found._repr_png_()
        image.sum().backward()
        gradients.append(colour.grad)
    assert torch.equal(gradients[0], gradients[1]) and float(gradients[0].abs().min()) > 0


def test_the_backward_pass_takes_what_the_forward_pass_took(scene: torchpt.Scene, monkeypatch: Any) -> None:
    from torchpt import gradients as adjoint

    taken: list[int] = []
    gradients = adjoint.gradients

    def spied(scene: Any, settings: Any, *rest: Any, **more: Any) -> Any:
        taken.append(settings.render.spp)
        return gradients(scene, settings, *rest, **more)

    monkeypatch.setattr(adjoint, "gradients", spied)
    name = "materials.grey.reflectance"
    wishes: list[dict[str, Any]] = [{"spp": 3}, {"spp": 3, "spp_grad": 2}, {"spp": 10**6, "target_error": 0.2}]
    for wish in wishes:
        colour = scene.params[name].clone().requires_grad_()
        full = torchpt.render(scene, params={name: colour}, full=True, **wish)
        full.image.sum().backward()
        assert taken.pop() == wish.get("spp_grad", full.spp) and full.spp < 100


def test_denoised(scene: torchpt.Scene, halved: list[Any], tmp_path: Path) -> None:
    name = "materials.grey.reflectance"
    colour = scene.params[name].clone().requires_grad_()
    for params in (None, {name: colour}):
        full = torchpt.render(scene, film=film("depth", denoise=True), params=params, spp=2, full=True)
        assert full.denoised is not None and torch.equal(full.denoised, 0.5 * full.image.detach())
        assert tuple(full.layers) == ("depth",) and full._repr_html_().count("<img") == 2
    assert halved == [("albedo", "normal")] * 2
    full.write(tmp_path / "a.exr")
    assert torch.equal(torchpt.read_image(tmp_path / "a.denoised.exr"), full.denoised)
    assert torchpt.read_header(tmp_path / "a.denoised.exr")["denoised"] == 1
    with pytest.raises(SceneError, match="film.denoise: expected false, or full=True"):
        torchpt.render(scene, film=film(denoise=True))


def test_without_a_denoiser_nothing_is_rendered(scene: torchpt.Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    import torchpt.rendering.api

    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("rendered")

    def none() -> None:
        raise RenderError("denoising needs the package pyoidn: pip install '.[denoise]' in the checkout of torchpt")

    monkeypatch.setattr(torchpt.rendering.api, "render_scene", never)
    monkeypatch.setattr(denoiser, "_library", none)
    with pytest.raises(RenderError, match="pip install"):
        torchpt.render(scene, film=film(denoise=True), full=True)


@pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed (extra `denoise`)")
def test_really_denoised(scene: torchpt.Scene) -> None:
    full = torchpt.render(scene, film=film(denoise=True), full=True)
    assert full.denoised is not None and torch.equal(full.denoised, torchpt.denoise(full.image, **full.guides))


# -- files


def test_written_as_the_command_writes(scene: torchpt.Scene, tmp_path: Path) -> None:
    shown = {"exposure": 1.0, "tonemap": "aces", "gamma": 0.5}
    full = torchpt.render(scene, film=film("depth", "samples", **shown), pilots=True, seed=2**40, full=True)
    full.write(tmp_path / "a.exr")
    full.write(tmp_path / "a.png")
    assert {file.name for file in tmp_path.iterdir()} == {"a.exr", "a.png"}
    layers = torchpt.read_layers(tmp_path / "a.exr")
    assert set(layers) == {"image", "depth", "samples"} and torch.equal(layers["image"], full.image)
    assert torch.equal(layers["samples"], full["samples"])
    torchpt.write_image(tmp_path / "b.png", full.image, **shown)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    facts = torchpt.read_header(tmp_path / "a.exr")
    assert full.relmse is not None and full.relmse_interval is not None
    numbers = dict(zip(("relmse_low", "relmse_high"), full.relmse_interval, strict=True)) | {"relmse": full.relmse}
    numbers |= {f"{part}_seconds": getattr(full, f"{part}_seconds") for part in ("load", "build", "compile", "render")}
    assert {name: facts[name] for name in numbers} == pytest.approx(numbers, rel=1e-6)
    assert (facts["spp"], facts["seed"], facts["rays"], facts["complete"]) == (8, 2**40, full.rays, 1)
    assert (facts["integrator"], facts["sampler"], facts["version"]) == ("path", "sobol", torchpt.__version__)
    assert "scene" not in facts  # it came as a mapping
    with pytest.raises(OutputError, match="needs an ending"):
        full.write(tmp_path / "a")


def test_the_scene_has_the_name_of_its_file() -> None:
    full = torchpt.render(torchpt.load("cornell_box", "cpu"), film={"width": 4, "height": 4}, spp=1, full=True)
    assert full.header()["scene"] == full.scene == "cornell_box"


def test_a_header_says_nothing_that_is_not_known() -> None:
    facts = torchpt.Rendering(torch.zeros(2, 3, 3), relmse=float("nan")).header()
    assert not {"relmse", "relmse_low", "heavy_tailed", "scene", "seed"} & set(facts) and facts["spp"] == 0


# -- notebooks


def test_one_line(scene: torchpt.Scene) -> None:
    text = repr(torchpt.render(scene, film=film("depth"), pilots=True, full=True))
    assert text.startswith("Rendering(24 x 16; samples a pixel: 8; relMSE: 0.") and "\n" not in text
    assert "layers: depth" in text and "tensor" not in text and len(text) < 300
    assert repr(torchpt.Rendering(torch.zeros(2, 3, 3))).startswith("Rendering(3 x 2; samples a pixel: 0; ")


def test_a_notebook_shows_the_picture_as_the_film_says(scene: torchpt.Scene, tmp_path: Path) -> None:
    full = torchpt.render(scene, film=film(exposure=1.0, tonemap="filmic", gamma=0.5), full=True)
    with Image.open(BytesIO(full._repr_png_())) as shown:
        pixels = np.asarray(shown)
    full.write(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as written:
        assert np.array_equal(pixels, np.asarray(written))


def test_html_stands_alone(scene: torchpt.Scene) -> None:
    full = torchpt.render(scene, film=film("depth"), pilots=True, full=True)
    html = full._repr_html_()
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert b64decode(data) == full._repr_png_() and "http" not in html and "<script" not in html
    for fact in ("24 x 16", "samples a pixel", "relMSE", "of sampling", "depth"):
        assert fact in html
    assert "denoised" not in html and html.count("<div>") == html.count("</div>") == 1


def test_large_pictures_are_shown_smaller() -> None:
    image = torch.zeros(400, 1600, 3)
    image[:, :800] = 1.0
    image[0, 0] = torch.nan
    with Image.open(BytesIO(torchpt.Rendering(image)._repr_png_())) as shown:
        assert shown.size == (768, 192) and shown.format == "PNG"
        assert np.asarray(shown)[100, [10, 700], 0].tolist() == [255, 0]


def test_the_depth_of_the_background_is_zero_and_over_alpha_it_is_the_surfaces_own():
    """A wall 3 before an orthographic camera whose edge crosses pixels: they hold its distance times their coverage."""
    scene = torchpt.load(
        {
            "camera": {"type": "orthographic", "origin": [0, 0, 3], "target": [0, 0, 0], "width": 4.0},
            "shapes": {"wall": {"type": "rectangle", "transform": [{"scale": 0.83}]}},
            "lights": {"sky": {"type": "constant", "radiance": 1.0}},
        },
        "cpu",
    )
    film = {"width": 8, "height": 8, "filter": "box", "aovs": ["depth", "alpha"]}
    full = torchpt.render(scene, film=film, spp=64, full=True)
    depth, alpha = full["depth"], full["alpha"]
    assert set(depth[alpha == 0].tolist()) == {0.0}
    part = (alpha > 0.1) & (alpha < 0.9)
    assert int(part.sum()) >= 8 and int((alpha == 1).sum()) >= 4
    torch.testing.assert_close((depth / alpha)[alpha > 0], torch.full_like(depth[alpha > 0], 3.0))
    far = torch.where(alpha > 0, depth / alpha, torch.inf)  # what the docs say for an infinite background
    assert torch.isinf(far[alpha == 0]).all()
