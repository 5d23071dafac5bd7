"""``render.compile``: what ``on``, ``auto``, ``off`` mean: kernels or tensor operations."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch
from trials import film_of

import torchpt
from torchpt.core.errors import SceneError
from torchpt.engines.kernels import driver, programs
from torchpt.engines.kernels.threads import KernelsForward
from torchpt.rendering import scene_cache, uses_kernels
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings

FILM = {"width": 48, "height": 48, "filter": "box"}


def run(scene: torchpt.Scene, spp: int, mode: str | bool, seed: int = 1, **more: torch.dtype) -> Rendering:
    wish = {"film": FILM, "render": {"spp": spp, "compile": mode, "seed": seed}, "integrator": {"max_depth": 8}}
    return render_scene(scene, settings(scene.description, wish), **more)  # type: ignore[arg-type]


@pytest.fixture
def passes(monkeypatch) -> list[int]:
    """Samples of each pass that the loop took."""
    taken: list[int] = []
    original = KernelsForward.run

    def noted(self: KernelsForward, spans: Any, each: Any) -> bool:
        taken.append(spans[0][2])
        return original(self, spans, each)

    monkeypatch.setattr(KernelsForward, "run", noted)
    return taken


@pytest.mark.parametrize(
    ("mode", "uses_kernels"), [("auto", True), ("on", True), (True, True), ("off", False), (False, False)]
)
def test_auto_and_on_take_the_loop(passes, mode, uses_kernels):
    scene = torchpt.load("cornell_box", device="cpu")
    found = run(scene, 8, mode)
    assert sum(passes) == (8 if uses_kernels else 0)
    assert found.eager == ()
    assert (scene_cache(scene).kernels is not None) == uses_kernels


def test_the_summary_tells_the_time_that_compiling_took(monkeypatch):
    scene = torchpt.load("cornell_box", device="cpu")
    run(scene, 1, "off")  # which makes the kernels of the search
    assert run(scene, 1, "off").summary()["compile_seconds"] == 0.0
    first = run(scene, 1, "auto")
    assert 0.0 < first.compile_seconds < first.seconds
    assert first.summary()["compile_seconds"] == round(first.compile_seconds, 4)
    assert run(scene, 1, "auto").compile_seconds < 0.1  # programs are known by now; binding tables is all
    # The clock runs while kernels are made, and then alone: with one that ticks at each look, one tick a kernel.
    clock = iter(range(1000))
    monkeypatch.setattr(programs.time, "perf_counter", lambda: float(next(clock)))
    ticks = run(scene, 1, "auto").compile_seconds
    made = scene_cache(scene).kernels
    assert made is not None
    assert ticks >= len(made._made) > 0


def test_float64_stays_eager(passes):
    scene = torchpt.load("cornell_box", device="cpu")
    found = run(scene, 2, "auto", dtype=torch.float64)
    assert found.image.dtype == torch.float64 and not passes and scene_cache(scene).kernels is None
    assert torch.equal(found.image, run(scene, 2, "off", dtype=torch.float64).image)


def test_on_is_refused_in_float64():
    said = r"^render.compile: expected auto or off \(kernels compute in float32; this render is in float64\), got 'on'$"
    with pytest.raises(SceneError, match=said):
        run(torchpt.load("cornell_box", device="cpu"), 2, "on", dtype=torch.float64)


def test_on_is_refused_without_a_driver(monkeypatch):
    monkeypatch.setattr(driver, "library", lambda: None)
    device, box = torch.device("cuda:0"), torchpt.load("cornell_box", device="cpu").description
    on, auto = (settings(box, {"render": {"compile": mode}}) for mode in ("on", "auto"))
    with pytest.raises(SceneError, match=r"render.compile: .* auto or off \(there is no CUDA driver .* on cuda:0\)"):
        uses_kernels(on, device, torch.float32)
    assert not uses_kernels(auto, device, torch.float32) and uses_kernels(on, torch.device("cpu"), torch.float32)


def test_a_cpu_needs_no_compiler_of_the_system(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda *_: None)
    monkeypatch.setenv("PATH", "")
    monkeypatch.setattr(torch, "compile", None)
    assert run(torchpt.load("cornell_box", device="cpu"), 1, "on").complete


def test_under_a_tape_the_picture_is_compiled_and_the_gradient_is_that_of_tensor_operations(passes):
    scene = torchpt.load("cornell_box", device="cpu")
    name = next(name for name in scene.params if name.endswith("reflectance"))
    keys = {"spp": 4, "seed": 3, "seed_grad": 5, "film": {**film_of(16), "filter": "box"}}
    plain = torchpt.render(scene, **keys)
    assert sum(passes) == 4
    gradients, pictures = [], []
    for mode in ("auto", "off"):
        value = scene.params[name].clone().requires_grad_()
        passes.clear()
        picture = torchpt.render(scene, params={name: value}, compile=mode, **keys)
        assert picture.requires_grad and sum(passes) == (4 if mode == "auto" else 0)
        passes.clear()
        # A constant cotangent: the backward pass does not hear of the forward picture.
        picture.backward(torch.ones_like(picture))
        assert not passes  # the backward pass has kernels of its own
        assert value.grad is not None
        gradients.append(value.grad)
        pictures.append(picture.detach())
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=0.0)
    assert float(gradients[0].abs().sum()) > 0
    assert torch.equal(pictures[0], plain)
    assert torch.isclose(*pictures, rtol=1e-3, atol=1e-5).float().mean() > 0.99
