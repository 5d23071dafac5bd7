"""Bidirectional path tracing: the means of ``path`` in rooms of every kind, and what it finds that ``path`` does not."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from few import few
from light_rooms import ROOMS, room
from significance import t_limit

import torchpt
from torchpt.core.errors import NotBuiltError
from torchpt.math.vectors import rows
from torchpt.paths.integrators.kinds.bdpt import STRATEGIES, Bdpt
from torchpt.paths.integrators.weights import Arrival, behind, reduced, reverse_pdf
from torchpt.paths.surface import surface_at
from torchpt.physics.lights.emission import density_of_hit, emit, light_weight
from torchpt.physics.shapes import interact, offset_origin
from torchpt.physics.shapes.geometry import Hit
from torchpt.scene.formats.description import settings
from torchpt.scene.prepare import make_wave

#: Seeds of each integrator.
SEEDS = 12


def pictures(scene: torchpt.Scene, name: str, spp: int, compile: str = "on", **keys: Any) -> torch.Tensor:
    integrator = {"type": name, **keys}
    return torch.stack(
        [torchpt.render(scene, integrator=integrator, spp=spp, seed=k + 1, compile=compile) for k in range(SEEDS)]
    ).double()


def means(images: torch.Tensor, side: int) -> torch.Tensor:
    """Return the luminance of blocks ``(SEEDS, blocks)`` of ``side`` pixels."""
    n, height, width, _ = images.shape
    light = images @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    return light.reshape(n, height // side, side, width // side, side).mean((2, 4)).reshape(n, -1)


def assert_same_means(a: torch.Tensor, b: torch.Tensor) -> None:
    for side in (16, 4):
        x, y = means(a, side), means(b, side)
        z = (x.mean(0) - y.mean(0)) / ((x.var(0) + y.var(0)) / SEEDS).sqrt().clamp_min(1e-12)
        assert float(z.abs().max()) < t_limit(z.numel(), SEEDS - 1), (side, float(z.abs().max()))
        assert float(z.square().mean()) < 2.0 or z.numel() < 2


def test_the_mean_of_path_among_diffuse_walls():
    shapes = {name: ROOMS["thin lens"]["shapes"][name] for name in ("floor", "back", "left", "lamp")}
    lights = {"sky": {"type": "constant", "radiance": 0.2}, "point": {"type": "point", "position": [0.5, 1, 1]}}
    scene = torchpt.load({**ROOMS["thin lens"], "shapes": shapes, "lights": lights}, device="cpu")
    assert_same_means(pictures(scene, "path", 128), pictures(scene, "bdpt", 128))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_the_mean_of_path(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    assert_same_means(pictures(scene, "path", 1024), pictures(scene, "bdpt", 1024))


@pytest.mark.parametrize("name", few(ROOMS, 1))
def test_strategies_add_up_to_the_picture(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    wish: dict[str, Any] = {"spp": 4, "compile": "off", "full": True}
    whole = torchpt.render(scene, integrator="bdpt", **wish)
    parts = [
        torchpt.render(scene, integrator={"type": "bdpt", "strategy": strategy, "weighted": True}, **wish).image
        for strategy in STRATEGIES
    ]
    assert torch.allclose(whole.image, sum(parts[1:], parts[0]), rtol=1e-5, atol=1e-6) and not whole.nonfinite_samples
    assert parts[1].any() and parts[2].any()


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["light", "light_paths"])
def test_a_strategy_alone(strategy):
    """Of direct light on surfaces that scatter, seen by rays that meet no lamp, either finds all."""
    shapes = {name: ROOMS["thin lens"]["shapes"][name] for name in ("floor", "back", "left", "lamp")}
    scene = torchpt.load({**ROOMS["thin lens"], "shapes": shapes}, device="cpu")
    a = pictures(scene, "path", 256)
    b = pictures(scene, "bdpt", 256, strategy=strategy)
    rows = slice(8, 16)  # the lamp is above
    assert_same_means(a[:, rows].repeat(1, 2, 1, 1), b[:, rows].repeat(1, 2, 1, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["many lamps", "lamps of all shapes"])
def test_fewer_light_paths(name):
    scene = torchpt.load(ROOMS[name], device="cpu")
    assert_same_means(pictures(scene, "bdpt", 64), pictures(scene, "bdpt", 64, light_paths=0.25))


@pytest.mark.slow
def test_part_of_a_film():
    whole = torchpt.load(ROOMS["thin lens"], device="cpu")
    part = {"width": 32, "height": 32, "filter": "gaussian", "crop": [8, 4, 16, 16]}
    a, b = (
        torch.stack(
            [torchpt.render(whole, integrator=name, spp=64, seed=seed + 1, film=part) for seed in range(SEEDS)]
        ).double()
        for name in ("path", "bdpt")
    )
    assert a.shape == (SEEDS, 16, 16, 3)
    assert_same_means(a, b)


GLASS = {
    "camera": {"origin": [0, 2, 6], "target": [0, 0.7, 0], "fov": 40},
    "film": {"width": 24, "height": 18, "filter": "box"},
    "shapes": {
        "floor": {"type": "rectangle", "transform": [{"scale": 4}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}]},
        "bulb": {"type": "sphere", "center": [0, 1, 0], "radius": 0.5, "material": {"type": "dielectric"}},
    },
    "lights": {"p": {"type": "point", "position": [0, 1, 0], "intensity": 10}},
}


def test_a_point_in_the_middle_of_a_glass_ball():
    """All rays meet the glass at right angles: it lets (1 - R)^2 out, and what is reflected within it comes back."""
    bare = {**GLASS, "shapes": {"floor": GLASS["shapes"]["floor"]}}
    glass, free = torchpt.load(GLASS, device="cpu"), torchpt.load(bare, device="cpu")
    direct = {"type": "bdpt", "max_depth": 2, "light_paths": 1.0}
    assert not torchpt.render(glass, integrator="path", spp=4).any()
    # Straight through the ball, of radius 0.5: three edges more than without it would reach the floor in one.
    once = torchpt.render(glass, integrator={**direct, "max_depth": 3}, spp=256, compile="off")
    plain = torchpt.render(free, integrator=direct, spp=256, compile="off")
    passed = 1.0 - 0.2**2  # of eta 1.5, at right angles
    floor = slice(13, 18)  # rows in which the ball does not stand
    assert float(once[floor].mean() / plain[floor].mean()) == pytest.approx(passed, rel=1.5e-2)
    # Light that is reflected n times within leaves along the same rays: passed * sum of R^n = 1.
    many = torchpt.render(glass, integrator={"type": "bdpt", "max_depth": 12}, spp=256, compile="off")
    assert float(
        many[floor].mean() / torchpt.render(free, integrator="bdpt", spp=256, compile="off")[floor].mean()
    ) == pytest.approx(1.0, rel=2e-2)


@pytest.mark.slow
def test_a_small_lamp_is_found_with_less_noise():
    """Where its light falls through glass: on the floor, and not where the lamp is seen through the ball."""
    lamp = {
        "type": "rectangle",
        "emission": [300, 275, 225],
        "transform": [{"scale": 0.06}, {"rotate": {"axis": [1, 0, 0], "angle": 90}}, {"translate": [0, 1.9, 0]}],
    }
    scene = torchpt.load(room(materials={"glass": {"type": "dielectric"}}, shapes={"lamp": lamp}), device="cpu")
    a, b = (pictures(scene, name, 64).var(0).mean(-1).flatten().median() for name in ("path", "bdpt"))
    assert float(b) < 0.2 * float(a)


def test_a_checkpoint_goes_on_to_the_bit(tmp_path):
    scene, file = torchpt.load(GLASS, device="cpu"), str(tmp_path / "half.ckpt")
    whole = torchpt.render(scene, integrator="bdpt", spp=8)
    torchpt.render(scene, integrator="bdpt", spp=5, checkpoint=file)
    assert torch.equal(whole, torchpt.render(scene, integrator="bdpt", spp=8, checkpoint=file, resume=True))


def test_a_scene_without_light_is_black():
    dark = {**GLASS, "lights": {}}
    assert not torchpt.render(torchpt.load(dark, device="cpu"), integrator="bdpt", spp=2, compile="off").any()


def test_gradients_are_refused():
    scene = torchpt.load(GLASS, device="cpu")
    leaf = scene.params["lights.p.intensity"].clone().requires_grad_()
    image = torchpt.render(scene, params={"lights.p.intensity": leaf}, integrator="bdpt", spp=1, compile="off")
    with pytest.raises(NotBuiltError, match="such as path"):
        image.sum().backward()


# ---- Weights


def lambert(scene: dict[str, Any]) -> torchpt.Scene:
    return torchpt.load(scene, device="cpu")


def test_weights_of_all_strategies_sum_to_one():
    """For random paths of three edges, with densities by hand."""
    lamp = {"type": "rectangle", "emission": 3, "transform": [{"scale": 0.5}, {"translate": [0.2, 1, -0.9]}]}
    shapes = {"lamp": lamp, "ball": {"type": "sphere", "center": [0.4, 0.4, 0.2], "radius": 0.35, "material": "metal"}}
    scene = torchpt.load(room(shapes=shapes), device="cpu")
    wave = make_wave(scene, settings(scene.description, {"integrator": Bdpt()}), None, torch.float64)
    light_wave = wave.light_paths
    assert light_wave is not None
    world, context, emission = wave.context.world, wave.context, wave.context.world.emission
    assert emission is not None
    n = 4096
    numbers = torch.Generator().manual_seed(7)

    def shot(o: torch.Tensor, d: torch.Tensor) -> tuple[Any, torch.Tensor]:
        t, prim, u, v = wave.accel.intersect(o, d, torch.full_like(o[0], math.inf))
        hit = Hit(t.double(), prim.long(), u.double(), v.double())
        met = hit.prim >= 0
        safe = Hit(hit.t, hit.prim.clamp_min(0), hit.u, hit.v)
        return interact(world, o, d, safe), met

    def model_of(at: Any) -> torch.Tensor:
        return world.materials.key[at.slot + 1].long() % len(world.materials.models)

    # A light path y0, y1, y2; then the same points as a camera path.
    u, v = (torch.rand(2, n, generator=numbers, dtype=torch.float64) for _ in range(2))
    ray = emit(emission, None, u, v, 1e-5)
    one, met = shot(ray.o, ray.d)
    turn = torch.nn.functional.normalize(torch.randn(3, n, generator=numbers, dtype=torch.float64), dim=0)
    turn = turn * torch.sign((turn * one.ng).sum(0)) * -torch.sign((ray.d * one.ng).sum(0))
    two, met_again = shot(offset_origin(world, one, turn), turn)
    eye = wave.camera.origin()
    view = torch.nn.functional.normalize(eye - two.p, dim=0)
    models = [str(m) for m in world.materials.models]
    checked = 0
    for first in range(len(models)):
        for second in range(len(models)):
            kinds = world.materials.models[first], world.materials.models[second]
            if kinds[0].transmits or kinds[1].transmits:
                continue
            lanes = met & met_again & (model_of(one) == first) & (model_of(two) == second)
            lanes &= (one.slot != two.slot) & ((view * two.ng).sum(0) * (turn * two.ng).sum(0) < 0)
            index = lanes.nonzero()[:, 0]
            if len(index) < 8:
                continue

            def of(x: Any, index: torch.Tensor = index) -> Any:
                return rows(x, index)

            a, b, d0, d1, w = of(one), of(two), ray.d[:, index], turn[:, index], view[:, index]
            start = of(ray)
            pixels = 16.0 * 16.0
            density = wave.camera.film_density(-w) / ((eye - b.p).square().sum(0)) * (w * b.ng).sum(0).abs()
            # As a light path, joined to the camera.
            lit = surface_at(world, first, d0, a)
            cosine = Arrival.cosine_of(d0, a)
            share = light_weight(emission, start, a.p, lit.frame.n)
            arrival = Arrival(1.0 / (start.density * share * cosine), start.met / start.density / cosine, cosine)
            pdf = kinds[0].pdf(lit.parameters, lit.wo, lit.frame.to_local(d1))
            back = reverse_pdf(light_wave.context, first, a, lit, -d0, d1)
            dvc = behind(light_wave.context, first, a, lit, arrival, d1, pdf, None, back)
            reach = Arrival.cosine_of(d1, b)
            end = Arrival(torch.zeros_like(dvc), dvc / reach, reach)
            lit = surface_at(world, second, d1, b)
            by_splat = reduced(None, density / pixels * end.others(reverse_pdf(context, second, b, lit, -d1, w)))
            # As a camera path, from the same points.
            seen = surface_at(world, second, -w, b)
            at_eye = Arrival(pixels / density, torch.zeros_like(dvc), Arrival.cosine_of(w, b))
            forth = kinds[1].pdf(seen.parameters, seen.wo, seen.frame.to_local(-d1))
            back = reverse_pdf(context, second, b, seen, w, -d1)
            dvc = behind(context, second, b, seen, at_eye, -d1, forth, None, back)
            seen = surface_at(world, first, -d1, a)
            cosine = Arrival.cosine_of(d1, a)
            last = Arrival(torch.zeros_like(dvc), dvc / cosine, cosine)
            # A light sample there, and a ray there that meets the lamp.
            by_bsdf = kinds[0].pdf(seen.parameters, seen.wo, seen.frame.to_local(-d0))
            ratio = by_bsdf * share
            two_ways = 1.0 / (1.0 + ratio * ratio)
            back = reverse_pdf(context, first, a, seen, d1, -d0)
            other = start.density * share * (d0 * a.ng).sum(0).abs() * last.others(back)
            by_sample = two_ways * reduced(two_ways, other)
            behind_it = behind(context, first, a, seen, last, -d0, by_bsdf, None, back)
            two_ways = torch.where(by_bsdf > 0, 1.0 / (1.0 + (1.0 / ratio) ** 2), 0.0)
            lamp_at = interact(
                world, a.p, -d0, Hit(torch.ones_like(ratio), _lamp(world, len(ratio)), start.p[0] * 0, start.p[0] * 0)
            )
            emitted = density_of_hit(emission, lamp_at)
            by_hit = two_ways * reduced(two_ways, emitted * behind_it)
            total = by_splat + by_sample + by_hit
            good = (pdf > 0) & (by_bsdf > 0) & (forth > 0)
            assert torch.allclose(total[good], torch.ones_like(total[good]), atol=1e-5), (first, second)
            assert all(bool((weight[good] >= 0.0).all()) for weight in (by_splat, by_sample, by_hit))
            checked += int(good.sum())
    assert checked > 500


def _lamp(world: Any, n: int) -> torch.Tensor:
    return torch.full((n,), int((world.lights.row_of_prim == 0).nonzero()[0, 0]))
