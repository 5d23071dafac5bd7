"""``render.compile``: what ``on``, ``auto``, ``off`` mean: on a CPU kernels of the loop, on CUDA few graphs."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
import torch
from trials import film_of

import torchpt
from torchpt.format.description import settings
from torchpt.forward import kept
from torchpt.integrators import compiled
from torchpt.integrators.loop import kernels
from torchpt.integrators.loop.schedule import Loop
from torchpt.rendering import Rendering, render_scene
from torchpt.samplers import points_of

FILM = {"width": 48, "height": 48, "filter": "box"}


def run(scene: torchpt.Scene, spp: int, mode: str | bool, seed: int = 1, **more: torch.dtype) -> Rendering:
    wish = {"film": FILM, "render": {"spp": spp, "compile": mode, "seed": seed}, "integrator": {"max_depth": 8}}
    return render_scene(scene, settings(scene.description, wish), **more)  # type: ignore[arg-type]


@pytest.fixture
def passes(monkeypatch) -> list[int]:
    """Samples of each pass that the loop took."""
    taken: list[int] = []
    kept = Loop.run

    def noted(self: Loop, spans: Any, each: Any) -> bool:
        taken.append(spans[0][2])
        return kept(self, spans, each)

    monkeypatch.setattr(Loop, "run", noted)
    return taken


# -- on a CPU


@pytest.mark.parametrize(
    ("mode", "looped"), [("auto", True), ("on", True), (True, True), ("off", False), (False, False)]
)
def test_auto_and_on_take_the_loop(passes, mode, looped):
    scene = torchpt.load("cornell_box", device="cpu")
    found = run(scene, 8, mode)
    assert sum(passes) == (8 if looped else 0)
    assert found.eager == ()
    assert (kept(scene).kernels is not None) == looped
    assert not kept(scene).stages  # graphs are for CUDA


def test_the_summary_tells_the_time_that_compiling_took(monkeypatch):
    scene = torchpt.load("cornell_box", device="cpu")
    assert run(scene, 1, "off").summary()["compile_seconds"] == 0.0
    first = run(scene, 1, "auto")
    assert 0.0 < first.compile_seconds < first.seconds
    assert first.summary()["compile_seconds"] == round(first.compile_seconds, 4)
    assert run(scene, 1, "auto").compile_seconds < 0.1  # programs are known by now; binding tables is all
    # The clock runs while kernels are made, and then alone: with one that ticks at each look, one tick a kernel.
    clock = iter(range(1000))
    monkeypatch.setattr(kernels.time, "perf_counter", lambda: float(next(clock)))
    ticks = run(scene, 1, "auto").compile_seconds
    made = kept(scene).kernels
    assert made is not None
    assert ticks >= len(made._made) > 0


def test_float64_stays_eager(passes):
    scene = torchpt.load("cornell_box", device="cpu")
    found = run(scene, 2, "on", dtype=torch.float64)
    assert found.image.dtype == torch.float64 and not passes and found.compile_seconds == 0.0
    assert torch.equal(found.image, run(scene, 2, "off", dtype=torch.float64).image)


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


# -- on CUDA


def graphs(scene: torchpt.Scene) -> dict[str, int]:
    counts: dict[str, int] = {}
    for stages in kept(scene).stages.values():
        counts |= stages.graphs
    return counts


warns = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::FutureWarning"
)  # torch's own, while compiling


@warns
@pytest.mark.gpu
def test_two_graphs_a_stage_and_none_later():
    scene = torchpt.load("cornell_box", device="cuda")
    first = run(scene, 4, "on")
    after_first_pass = graphs(scene)
    assert {name.split()[0] for name in after_first_pass} == {"generate", "emit", "bounce"}
    assert all(count <= 2 for count in after_first_pass.values()), after_first_pass
    later = [run(scene, spp, "on", seed) for spp, seed in ((37, 2), (64, 3))]  # other wave sizes, ragged last passes
    assert graphs(scene) == after_first_pass
    # Fused arithmetic rounds differently, and a few paths go elsewhere for it; the picture is the same.
    for compiled_picture, spp, seed in zip((first, *later), (4, 37, 64), (1, 2, 3), strict=True):
        eager = run(scene, spp, "off", seed)
        close = torch.isclose(compiled_picture.image, eager.image, rtol=1e-3, atol=1e-4).all(-1)
        assert close.float().mean() > 0.9
        assert float(compiled_picture.image.mean()) == pytest.approx(float(eager.image.mean()), rel=2e-3)


@warns
@pytest.mark.gpu
def test_more_graphs_than_two_are_an_error_not_a_fall_back():
    scene = torchpt.load("cornell_box", device="cuda")
    world, _ = scene.world(torch.float32)
    plan = compiled.Plan(points_of("sobol"), "mis", None, torch.float32, False, False)
    stages = compiled.CompiledStages(plan, world)

    def stage(x: torch.Tensor) -> torch.Tensor:
        return x * 2

    made = stages._get("stage", (), stage)
    with pytest.raises(Exception, match=r"(?i)recompile"):
        for rank in range(1, 6):  # a graph for each number of axes
            made(torch.ones((2,) * rank, device="cuda"))
    assert stages.graphs["stage"] <= 2


@warns
@pytest.mark.gpu
@pytest.mark.slow
def test_textures_and_maps_compile():
    """Long chains of indices and frames: with inductor's own settings their compilation does not end."""
    squares = {"type": "checkerboard", "scale": 9, "filter": "trilinear"}
    material = {
        "type": "diffuse",
        "reflectance": squares,
        "normal_map": {**squares, "color0": [0.6, 0.45, 0.95], "color1": [0.4, 0.5, 0.95]},
    }
    scene = torchpt.load(
        {
            "camera": {"origin": [0, 1, 4], "target": [0, 0, 0]},
            "shapes": {
                "floor": {
                    "type": "rectangle",
                    "material": material,
                    "transform": [{"scale": 3}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
                },
                "lamp": {
                    "type": "rectangle",
                    "emission": 20,
                    "transform": [
                        {"rotate": {"axis": [1, 0, 0], "angle": 90}},
                        {"scale": 0.3},
                        {"translate": [0, 2, 0]},
                    ],
                },
            },
        },
        "cuda",
    )
    wish = {"film": FILM, "render": {"spp": 4}, "integrator": {"max_depth": 3}}
    pictures = [
        render_scene(scene, settings(scene.description, {**wish, "render": {"spp": 4, "compile": mode}})).image
        for mode in ("on", "off")
    ]
    assert torch.isclose(*pictures, rtol=1e-3, atol=1e-4).all(-1).float().mean() > 0.9
    assert float(pictures[0].mean()) == pytest.approx(float(pictures[1].mean()), rel=2e-3)
