"""What the denoiser does to pictures, and to what are none."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import product

import pytest
import torch
from few import few
from torch import Tensor

import torchpt
from torchpt import metrics
from torchpt.core.errors import RenderError, SceneError
from torchpt.images.denoiser import GUIDES
from torchpt.rendering import Rendering
from torchpt.rendering.api import render_scene
from torchpt.scene.formats.description import settings
from torchpt.scene.settings import Settings

needs_library = pytest.mark.skipif(find_spec("pyoidn") is None, reason="pyoidn is not installed (extra `denoise`)")
SIDE = 48


def settings_of(scene: torchpt.Scene, **film: object) -> Settings:
    return settings(
        scene.description, {"film": {"width": SIDE, "height": SIDE, **film}, "render": {"spp": 8, "seed": 5}}
    )


@pytest.fixture(scope="module")
def scene() -> torchpt.Scene:
    return torchpt.load("cornell_box", device="cpu")


@pytest.fixture(scope="module")
def rendering(scene: torchpt.Scene) -> Rendering:
    return render_scene(scene, settings_of(scene, denoise=True, aovs=["depth"]))


@pytest.mark.parametrize("compiled", ["on", "off"])
def test_the_noisy_picture_and_its_numbers_stay_as_they_are(scene: torchpt.Scene, compiled: str) -> None:
    plain, guided = (settings_of(scene, denoise=wish) for wish in (False, True))
    first, second = (
        render_scene(scene, replace(wish, render=wish.render.but(compile=compiled))) for wish in (plain, guided)
    )
    assert torch.equal(first.image, second.image) and first.relmse == second.relmse
    assert first.layers == {} and second.layers == {} and first.guides == {}
    assert second.denoised is None  # rendering measures and filters nothing by itself
    for name, layer in second.guides.items():
        shown = torchpt.render(
            scene, integrator="aov", film={"width": SIDE, "height": SIDE, "aovs": [name]}, spp=8, seed=5
        )
        assert torch.allclose(layer, shown, atol=1e-6)


def test_layers_are_those_asked_for(scene: torchpt.Scene, rendering: Rendering) -> None:
    assert set(rendering.layers) == {"depth"} and tuple(rendering.guides) == GUIDES
    both = render_scene(scene, settings_of(scene, denoise=True, aovs=["normal", "variance"]))
    assert list(both.layers) == ["normal", "variance"] and torch.equal(both.layers["normal"], both.guides["normal"])


@needs_library
def test_the_error_falls(scene: torchpt.Scene, rendering: Rendering) -> None:
    film = {"width": SIDE, "height": SIDE}
    reference = torchpt.render(scene, film=film, spp=256, seed=17)
    noisy = metrics.relmse(rendering.image, reference)
    alone = metrics.relmse(torchpt.denoise(rendering.image), reference)
    guided = metrics.relmse(torchpt.denoise(rendering.image, **rendering.guides), reference)
    assert alone < noisy / 4 and guided < noisy / 6  # measured: 8 and 12 times less


@needs_library
@pytest.mark.parametrize(
    ("level", "size"), few(product([1e-30, 1e-9, 0.5, 1e4, 3e38], [(1, 1), (1, 7), (33, 17), (64, 40)]), 3)
)
def test_a_constant_picture_stays_so(size: tuple[int, int], level: float) -> None:
    grey = torch.full((*size, 3), level)
    assert torch.allclose(torchpt.denoise(grey), grey, rtol=5e-3, atol=0)
    flat = torch.full((*size, 3), 0.5)
    assert torch.allclose(torchpt.denoise(grey, albedo=flat, normal=flat), grey, rtol=2e-2, atol=0)


@needs_library
def test_black_stays_black_and_negative_values_count_as_black() -> None:
    assert torch.equal(torchpt.denoise(torch.zeros(9, 5, 3)), torch.zeros(9, 5, 3))
    assert torch.equal(torchpt.denoise(torch.full((9, 5, 3), -1.0)), torch.zeros(9, 5, 3))


def noise(seed: int, *size: int) -> Tensor:
    return torch.rand(*size, 3, generator=torch.Generator().manual_seed(seed))


@needs_library
@pytest.mark.slow
def test_the_scale_of_radiance_and_the_number_of_threads_change_nothing() -> None:
    image, albedo, normal = noise(1, 37, 53), noise(2, 37, 53), 2 * noise(3, 37, 53) - 1
    before, threads = torchpt.denoise(image, albedo, normal), torch.get_num_threads()
    for power in (-60, -20, 20, 60):
        assert torch.equal(torchpt.denoise(image * 2.0**power, albedo, normal), before * 2.0**power)
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            assert torch.equal(torchpt.denoise(image, albedo, normal), before)
    finally:
        torch.set_num_threads(threads)


@needs_library
def test_a_small_sun_keeps_its_light_roughly() -> None:
    sky = torch.full((40, 40, 3), 0.5)
    sky[20:26, 20:26] = 1e4
    made = torchpt.denoise(sky)
    assert torch.isfinite(made).all() and made.sum() == pytest.approx(float(sky.sum()), rel=0.35)
    assert torch.allclose(made[:10], sky[:10], rtol=0.1)


@needs_library
def test_type_and_inputs_are_kept() -> None:
    image, albedo = noise(1, 20, 12), noise(2, 20, 12) * 2
    copies = image.clone(), albedo.clone()
    made = torchpt.denoise(image.transpose(0, 1), albedo.transpose(0, 1))  # not contiguous
    assert made.shape == (12, 20, 3) and made.dtype == torch.float32 and not made.requires_grad
    assert torch.equal(image, copies[0]) and torch.equal(albedo, copies[1])
    fine = torchpt.denoise(image.double())
    assert fine.dtype == torch.float64 and torch.equal(fine.float(), torchpt.denoise(image))
    hole = albedo.clone()
    hole[3, 3] = torch.nan  # a layer only hints: where it says nothing it is 0
    assert torch.isfinite(torchpt.denoise(image, hole)).all()


@needs_library
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_what_is_not_finite_is_refused(value: float) -> None:
    image = torch.ones(6, 5, 3)
    image[2, 3, 1] = image[4, 4] = value
    with pytest.raises(RenderError, match="expected finite values, got 2 pixels"):
        torchpt.denoise(image)


GREY = torch.ones(6, 5, 3)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"image": torch.ones(6, 5)}, r"image: expected \(H, W, 3\), got \(6, 5\)"),
        ({"image": torch.ones(6, 5, 4)}, r"image: expected \(H, W, 3\)"),
        ({"image": torch.ones(0, 5, 3)}, r"image: expected \(H, W, 3\)"),
        ({"image": torch.ones(6, 5, 3, dtype=torch.uint8)}, "image: expected a floating type"),
        (
            {"image": GREY, "albedo": torch.ones(6, 4, 3)},
            r"albedo: expected the picture's \(6, 5, 3\), got \(6, 4, 3\)",
        ),
        ({"image": GREY, "normal": GREY}, "normal: the denoiser takes it beside albedo only"),
        ({"image": GREY.clone().requires_grad_()}, r"image: requires gradients.*image.detach\(\)"),
    ],
)
def test_bad_arguments(given: dict[str, Tensor], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        torchpt.denoise(**given)


def test_without_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(RenderError, match=r"needs the package pyoidn: pip install '\.\[denoise\]' in the checkout"):
        torchpt.denoise(GREY)


@needs_library
def test_a_library_that_does_not_run_here_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    import pyoidn

    def broken() -> bool:
        raise OSError("libOpenImageDenoise.so: wrong ELF class")

    monkeypatch.setattr(pyoidn.Device, "is_cpu_available", staticmethod(broken))
    with pytest.raises(RenderError, match="cannot be loaded .*wrong ELF class"):
        torchpt.denoise(GREY)
    monkeypatch.setattr(pyoidn.Device, "is_cpu_available", staticmethod(lambda: False))
    with pytest.raises(RenderError, match="does not run on this CPU"):
        torchpt.denoise(GREY)


def test_a_render_in_python_is_one_picture(scene: torchpt.Scene) -> None:
    with pytest.raises(SceneError, match=r"film.denoise: expected false, or full=True: .*torchpt\.denoise"):
        torchpt.render(scene, film={"denoise": True})
    with pytest.raises(SceneError, match="film.denoise: expected true or false, got 'yes'"):
        torchpt.render(scene, film={"denoise": "yes"})


def test_a_scene_files_wish_leaves_the_picture_of_python_as_it_is() -> None:
    camera = {"origin": [0, 0, -4], "target": [0, 0, 0]}
    shapes = {"ball": {"type": "sphere", "emission": 1}}
    wishes = [{"width": 8, "height": 6}, {"width": 8, "height": 6, "denoise": True}]
    scenes = [torchpt.load({"camera": camera, "shapes": shapes, "film": film}, device="cpu") for film in wishes]
    first, second = (torchpt.render(scene, spp=2) for scene in scenes)
    assert torch.equal(first, second)


def test_an_integrator_without_light_is_refused(scene: torchpt.Scene) -> None:
    with pytest.raises(SceneError, match="film.denoise: expected false where integrator is aov"):
        settings(scene.description, {"film": {"denoise": True}, "integrator": {"type": "aov"}})
