"""Vertex connection and merging: weights of all strategies, the falling radius, and light that glass hides from ``bdpt``."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from few_lanes import few_lanes
from light_rooms import ROOMS
from same_means import assert_same_means, pictures

import torchpt
from torchpt.core.errors import SceneError
from torchpt.engines import tensors_forward
from torchpt.engines.kernels.engine import KernelsEngine
from torchpt.paths import photons
from torchpt.paths.integrators.kinds.bdpt import STRATEGIES
from torchpt.paths.integrators.kinds.vcm import Vcm
from torchpt.paths.photons import SentLight
from torchpt.rendering.api import render_scene
from torchpt.rendering.one_path import one_path
from torchpt.rendering.run import Run
from torchpt.scene.formats.description import settings
from torchpt.scene.prepare import make_wave

#: A floor, and a ball of glass around a point that shines, of which a part of the floor is seen through the ball.
LAMP: dict[str, Any] = {
    "camera": {"origin": [0, 2, 6], "target": [0, 0.7, 0], "fov": 30},
    "film": {"width": 32, "height": 24, "filter": "box"},
    "shapes": {
        "floor": {
            "type": "rectangle",
            "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}],
        },
        "bulb": {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "material": {"type": "dielectric"}},
    },
    "lights": {"p": {"type": "point", "position": [0, 1, 0], "intensity": 10}},
}


def test_strategies_add_up_to_the_picture():
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    wish: dict[str, Any] = {"spp": 3, "compile": "off", "full": True}
    keys = {"type": "vcm", "connections": "one", "radius": 0.3}
    whole = torchpt.render(scene, integrator=keys, **wish)
    parts = {
        strategy: torchpt.render(scene, integrator={**keys, "strategy": strategy, "weighted": True}, **wish).image
        for strategy in (*STRATEGIES, "merging")
    }
    assert torch.allclose(whole.image, sum(parts.values(), torch.zeros(())), rtol=1e-5, atol=1e-6)
    assert not whole.nonfinite_samples and all(part.any() for part in parts.values())


@pytest.mark.parametrize("keys", [{}, {"connections": "one"}], ids=["plain", "connected"])
def test_kernels_and_tensors_agree_for_any_threads_and_pieces(keys, monkeypatch):
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    wish: dict[str, Any] = {"spp": 3, "integrator": {"type": "vcm", "radius": 0.2, **keys}}
    of_tensors = torchpt.render(scene, compile="off", **wish)
    of_kernels = torchpt.render(scene, compile="on", threads=1, **wish)
    torch.testing.assert_close(of_kernels, of_tensors, rtol=2e-3, atol=1e-3)
    assert of_kernels.any() and torch.equal(torchpt.render(scene, compile="on", threads=2, **wish), of_kernels)
    make, lanes = tensors_forward.TensorsForward.__init__, []

    def with_few_lanes(self, wave, budget):
        budget.lanes = 100
        lanes.append(budget.lanes)
        make(self, wave, budget)

    monkeypatch.setattr(tensors_forward.TensorsForward, "__init__", with_few_lanes)
    torch.testing.assert_close(torchpt.render(scene, compile="off", **wish), of_tensors, rtol=1e-4, atol=1e-5)
    assert lanes


def test_chunks_and_threads_change_no_bit():
    """Nor where paths are connected, and only some samples have a light path."""
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    keys = {"type": "vcm", "radius": 0.2, "connections": "one", "light_paths": 0.5}
    wish: dict[str, Any] = {
        "spp": 2,
        "integrator": keys,
        "compile": "on",
        "full": True,
        "film": {"width": 40, "height": 30},
    }
    whole = torchpt.render(scene, threads=1, **wish)
    for lanes, threads in ((None, 2), (96, 1), (160, 3)):
        with few_lanes(lanes):
            found = torchpt.render(scene, threads=threads, **wish)
        assert torch.equal(found.image, whole.image) and found.rays == whole.rays, (lanes, threads)


@pytest.mark.parametrize("room", ["thin lens", pytest.param("parallel rays", marks=pytest.mark.slow)])
def test_the_mean_of_bdpt_where_merges_count_most(room, monkeypatch):
    """With a radius that blurs little, and weights that leave most of the light to merges."""
    monkeypatch.setattr(photons, "MERGE_SHARE", 30.0)
    scene = torchpt.load(ROOMS[room], device="cpu")
    keys: dict[str, Any] = {"radius": 0.05, "alpha": 1.0}
    merged = pictures(scene, "vcm", 4, first_seed=2001, strategy="merging", weighted=True, **keys)
    found = pictures(scene, "vcm", 32, first_seed=1001, **keys)
    assert merged.mean() > 0.1 * found.mean()
    assert_same_means(pictures(scene, "bdpt", 32), found)


@pytest.mark.slow
def test_light_seen_through_glass():
    """A floor under a glass plate that a spot shines through: what is seen without a plate before the camera is dimmed."""
    scene = torchpt.load(LAMP, device="cpu")
    outside = torch.zeros(24, 32, dtype=torch.bool)
    outside[16:] = True
    a, b = pictures(scene, "bdpt", 64), pictures(scene, "vcm", 64, first_seed=1001, radius=0.02)
    seen = (slice(None), slice(6, 12), slice(13, 19))
    assert not a[seen].any() and b[seen].mean() > 0.01
    rows = slice(16, 24)
    assert_same_means(a[:, rows].repeat(1, 2, 1, 1)[:, :16, 8:24], b[:, rows].repeat(1, 2, 1, 1)[:, :16, 8:24])


def test_the_radius_falls_as_the_square_of_what_is_left():
    integrator = Vcm(radius=2.0, alpha=0.7)
    expected = 4.0
    for sample in range(6):
        found = integrator.radius_at(sample)
        assert found is not None and found * found == pytest.approx(expected)
        expected *= (sample + 1 + 0.7) / (sample + 2)
    assert Vcm(radius=2.0, alpha=1.0).radius_at(1000) == pytest.approx(2.0)
    assert Vcm(radius=2.0, max_depth=1).radius_at(0) is None


def test_the_radius_that_nobody_gave_is_two_pixels():
    scene = torchpt.load(
        {
            "camera": {"type": "orthographic", "origin": [0, 0, 4], "target": [0, 0, 0], "width": 3},
            "film": {"width": 30, "height": 30},
            "shapes": {"wall": {"type": "rectangle", "transform": [{"scale": 5}]}},
            "lights": {"sky": {"type": "constant"}},
        },
        device="cpu",
    )
    wish = settings(scene.description, {"integrator": {"type": "vcm"}})
    wave = make_wave(scene, wish, None, torch.float32)
    assert isinstance(wave.integrator, Vcm) and wave.integrator.radius is not None
    assert wave.integrator.radius * scene.space.unit == pytest.approx(2.0 * 3.0 / 30.0, rel=0.06)
    given = settings(scene.description, {"integrator": {"type": "vcm", "radius": 0.5}})
    wave = make_wave(scene, given, None, torch.float32)
    assert isinstance(wave.integrator, Vcm) and wave.integrator.radius is not None
    assert wave.integrator.radius * scene.space.unit == pytest.approx(0.5)


def test_what_is_refused():
    scene = torchpt.load(LAMP, device="cpu")
    wish = settings(scene.description, {"integrator": {"type": "vcm"}})
    with pytest.raises(SceneError, match="one without merges beside ranks"):
        Run(scene, wish, None, torch.float32, group=SimpleNamespace(size=2, rank=0))  # pyright: ignore[reportArgumentType]
    with pytest.raises(SceneError, match="bdpt beside debug.pixel"):
        one_path(scene, wish, (1, 1), 0)
    with pytest.raises(SceneError, match="weighted: expected true beside strategy=merging"):
        torchpt.render(scene, integrator={"type": "vcm", "strategy": "merging"}, spp=1)
    grey = torch.full((3,), 0.5, requires_grad=True)
    diffuse = {**LAMP, "materials": {"grey": {"type": "diffuse"}}}
    diffuse["shapes"] = {**LAMP["shapes"], "floor": {**LAMP["shapes"]["floor"], "material": "grey"}}
    with pytest.raises(SceneError, match="expected one of path, direct, .* where gradients are wanted, got 'vcm'"):
        scene = torchpt.load(diffuse, device="cpu")
        torchpt.render(scene, params={"materials.grey.reflectance": grey}, integrator="vcm", spp=1)


@pytest.mark.parametrize("compiled", [True, False], ids=["kernels", "tensors"])
def test_a_picture_that_is_stopped_within_a_sample(compiled):
    """Splats come with the pixels that sent them: those of a part of the pixels do not brighten the whole picture."""
    scene = torchpt.load(LAMP, device="cpu")
    keys, film = {"type": "vcm", "radius": 1e-3, "light_paths": 1}, {"width": 192, "height": 144, "filter": "box"}
    render: dict[str, Any] = {"spp": 2, "compile": "on" if compiled else "off", "threads": 1}
    wish = settings(scene.description, {"integrator": keys, "film": film, "render": render})
    with few_lanes(512):
        whole = render_scene(scene, wish)
        part = render_scene(scene, wish, on_progress=lambda state: 0 < state.done)
    assert 0.5 < part.image.sum() / whole.image.sum() < 1.5 and part.spp == 0


def test_light_paths_are_traced_again_where_memory_ran_out(monkeypatch):
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    wish: dict[str, Any] = {"integrator": {"type": "vcm", "radius": 0.2}, "spp": 2, "threads": 2, "compile": "on"}
    whole, send, calls = torchpt.render(scene, full=True, **wish), KernelsEngine.send, [0]

    def failing(self: KernelsEngine, chunk: Any) -> Any:
        calls[0] += 1
        found = send(self, chunk)
        if calls[0] in (1, 2, 4):
            raise MemoryError
        return found

    monkeypatch.setattr(KernelsEngine, "send", failing)
    found = torchpt.render(scene, full=True, **wish)
    assert calls[0] > 4 and torch.equal(found.image, whole.image) and found.rays == whole.rays


@pytest.mark.parametrize("compiled", [True, False], ids=["kernels", "tensors"])
def test_photons_that_are_not_finite_are_counted(compiled, monkeypatch):
    """And the cause is named: traced again, camera paths are merged with nothing."""
    kept = SentLight.of

    def spoiled(first_pixel: int, pixels: int, sent: Any, *args: Any) -> SentLight:
        for lane, _, data in sent:
            data[3, (lane + first_pixel) == 70] = math.inf
        return kept(first_pixel, pixels, sent, *args)

    monkeypatch.setattr(SentLight, "of", spoiled)
    keys = {"type": "vcm", "radius": 0.2}
    scene = torchpt.load(ROOMS["thin lens"], device="cpu")
    found = torchpt.render(scene, integrator=keys, spp=1, compile="on" if compiled else "off", full=True)
    assert found.nonfinite_samples == 1 and found.nonfinite_causes == {"merge": 1}


def test_pictures_of_a_batch():
    """Light paths of all pixels come first, so that the tasks of a picture cannot be mixed with those of others."""
    scene = torchpt.load({**LAMP, "film": {"width": 8, "height": 6}}, device="cpu")
    for keys in ({}, {"strategy": "bsdf", "weighted": True}):
        wish: dict[str, Any] = {"integrator": {"type": "vcm", "radius": 0.3, "alpha": 0.1, **keys}, "spp": 4}
        alone = torch.stack([torchpt.render(scene, seed=seed, **wish) for seed in (7, 8)])
        batch = torchpt.render_batch([scene, scene], seed=[7, 8], **wish)
        assert torch.equal(torch.as_tensor(batch).reshape(alone.shape), alone)
        assert alone.any() == (not keys)
