"""Ways to the same mean: strategies, roulette, depth limits, pieces of the film, places and sizes of the scene."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import yaml
from few import few
from trials import film_of, shoot, spread, z_limit

import torchpt
from torchpt.core.files import configs

SMALL = film_of(24)


@pytest.fixture(scope="module")
def cornell():
    return torchpt.load("cornell_box", device="cpu")


def cornell_dict() -> dict[str, Any]:
    return yaml.safe_load((configs() / "scene" / "cornell_box.yaml").read_text())


def pictures(scene: Any, count: int, spp: int, first_seed: int, compile: str = "off", **integrator: Any):
    shots = [
        shoot(scene, spp, first_seed + k, integrator={"max_depth": 6, **integrator}, film=SMALL, compile=compile)
        for k in range(count)
    ]
    return spread([shot.image for shot in shots])


def blocks(image: torch.Tensor, side: int = 6) -> torch.Tensor:
    """Mean over ``side x side`` pixels: small biases add up, noise does not."""
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], side)[0]


def assert_same_mean(a: tuple[torch.Tensor, torch.Tensor], b: tuple[torch.Tensor, torch.Tensor], side: int = 6):
    """Block means agree: the largest deviate within its bound, and the whole pictures' too."""
    for s in (side, 24):
        variance = blocks(a[1] + b[1], s) / s**2
        z = (blocks(a[0], s) - blocks(b[0], s)) / variance.sqrt().clamp_min(1e-12)
        # Variances are estimated; the bound of a normal deviate is widened by a quarter for that.
        assert z.abs().max() <= 1.25 * z_limit(z.numel()), (s, z.abs().max())


@pytest.fixture(scope="module")
def by_mis(cornell):
    return pictures(cornell, 8, 64, 1000, "on")


@pytest.mark.parametrize(
    ("strategy", "keys", "spp"),
    [
        ("light", {}, 64),
        ("bsdf", {}, 128),
        pytest.param("uniform", {}, 256, marks=pytest.mark.slow),
        pytest.param("mis", {"rr_depth": 1000}, 32, marks=pytest.mark.slow),
        pytest.param("mis", {"rr_depth": 1}, 64, marks=pytest.mark.slow),
        ("mis", {"rr_depth": 1, "rr_prob": 0.6}, 64),
        pytest.param("mis", {"rr_depth": 2, "rr_prob": 1.0}, 32, marks=pytest.mark.slow),
    ],
)
def test_every_strategy_and_roulette_has_the_same_mean(cornell, by_mis, strategy, keys, spp):
    assert_same_mean(pictures(cornell, 8, spp, 2000, strategy=strategy, **keys), by_mis)


def test_sobol_has_the_mean_of_independent(cornell, by_mis):
    shots = [shoot(cornell, 16, k, "sobol", {"max_depth": 6}, SMALL).image for k in range(16)]
    assert_same_mean(spread(shots), by_mis)


def test_direct_is_a_path_of_two_edges(cornell):
    a = torchpt.render(cornell, spp=4, integrator="direct", film={**SMALL, "filter": "box"}, compile="off")
    b = torchpt.render(
        cornell, spp=4, integrator={"type": "path", "max_depth": 2}, film={**SMALL, "filter": "box"}, compile="off"
    )
    assert torch.equal(a, b)


def test_max_depth_0_is_black_and_1_is_emission(cornell):
    for compile in ("off", "on"):
        none = torchpt.render(cornell, spp=2, integrator={"type": "path", "max_depth": 0}, film=SMALL, compile=compile)
        assert not none.any()
    once = shoot(cornell, 16, integrator={"max_depth": 1}, film=film_of(64)).image
    lamp = torch.tensor([17.0, 12.0, 4.0])
    share = once / lamp  # coverage of the pixel by the lamp, the same in all channels
    assert 0 < share.amax() <= 1 + 1e-6
    assert (share[..., :1] - share).abs().max() < 1e-6
    assert (once.sum(2) > 0).float().mean() < 0.05


def test_deeper_is_brighter_with_the_same_numbers(cornell):
    means = [
        float(shoot(cornell, 8, integrator={"max_depth": depth, "rr_depth": 99}, film=SMALL).image.mean())
        for depth in (1, 2, 3, 5, 9)
    ]
    assert means == sorted(means)
    assert len(set(means)) == len(means)


def moved(scale: float, offset: float) -> dict[str, Any]:
    scene = cornell_dict()
    for shape in scene["shapes"].values():
        shape["transform"] = [*shape.get("transform", []), {"scale": scale}, {"translate": [offset] * 3}]
    for key in ("origin", "target"):
        scene["camera"][key] = [scale * x + offset for x in scene["camera"][key]]
    return scene


@pytest.mark.parametrize(("scale", "offset"), few([(1e6, -1e9), (1.0, 1e6), (1e-4, 0.0), (1e6, 0.0), (1e-4, 100.0)], 1))
def test_place_and_size_do_not_matter(by_mis, cornell, scale, offset):
    scene = torchpt.load(moved(scale, offset), device="cpu")
    assert_same_mean(pictures(scene, 8, 32, 3000), by_mis)
    # With the same numbers direct light is the same but for rounding: far stricter than noise allows. (Not so further
    # on: frames turn where a normal's z changes sign, and on axis-parallel walls that sign is rounding.)
    one, other = (
        shoot(s, 64, 7, "sobol", {"max_depth": 2, "strategy": "light"}, SMALL).image.double() for s in (cornell, scene)
    )
    assert abs(float(other.mean() / one.mean()) - 1) < 1e-3
    assert float(((other - one).abs() <= 1e-3 * one).double().mean()) > 0.95


@pytest.mark.parametrize("sampler", ["sobol", "independent"])
@pytest.mark.parametrize("crop", [[0, 0, 24, 24], [3, 5, 7, 11], [23, 23, 1, 1]])
def test_a_crop_shows_the_pixels_of_the_full_picture(cornell, sampler, crop):
    full = shoot(cornell, 6, 3, sampler, film=SMALL).image
    part = shoot(cornell, 6, 3, sampler, film={**SMALL, "crop": crop}).image
    x, y, w, h = crop
    assert torch.equal(part, full[y : y + h, x : x + w])


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4096, 1), (1, 33), (16384, 1)])
def test_odd_films(cornell, width, height):
    shot = shoot(cornell, 1, film=film_of(width, height))
    assert shot.image.shape == (height, width, 3)
    assert shot.paths == width * height
    assert shot.spp == 1
    assert torch.isfinite(shot.image).all()
    if width * height > 1:
        assert shot.image.amax() > 0


def test_a_film_of_one_pixel_averages_the_picture(cornell):
    lone, error = (float(x[0]) for x in one_pixel(cornell))
    whole = shoot(cornell, 16, 5, integrator={"max_depth": 6}, film=film_of(64)).image
    share = float(whole[..., 0].double().mean())
    assert abs(lone - share) < 4 * math.hypot(error, float(whole[..., 0].std()) / 64 / 4)


def one_pixel(scene: Any):
    shots = [shoot(scene, 512, k, integrator={"max_depth": 6}, film=film_of(1)).image for k in range(6)]
    mean, variance = spread(shots)
    return mean[0, 0], variance[0, 0].sqrt()
