"""Veach's plates: what each strategy is good for, and that all have one mean.

Either strategy alone is hopeless somewhere: drawn from the material, a path meets the smallest light from a diffuse surface
about once in 1e5 times; drawn from the lights, it meets the lobe of the sharpest plate about once in 500. There a sample's
variance says nothing about its error, at any affordable number of samples. So means are compared over a whole shape, where
such events add up, and the sharpest plate is left out for ``light``.
"""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from trials import coarse, film_of, shoot, z_limit

import torchpt
from torchpt.images.metrics import relmse

WIDTH, HEIGHT, FINE = 72, 48, 8
STRATEGIES = ("mis", "bsdf", "light")
HOPELESS = {"mis": (), "bsdf": (), "light": ("plate1",)}


@pytest.fixture(scope="module")
def veach():
    return torchpt.load("veach_mis", device="cpu")


@pytest.fixture(scope="module")
def reference():
    layers = torchpt.read_layers(Path(__file__).parent.parent / "references" / "veach_mis.exr")
    return layers["image"].double(), layers["variance"].double()


@pytest.fixture(scope="module")
def shapes(veach):
    """Pixels ``(H, W)`` that show nothing but one shape, by name, far enough from the lights' edges."""
    film = {**film_of(FINE * WIDTH, FINE * HEIGHT), "aovs": ["object_id"]}
    shot = shoot(veach, 4, 2, film=film, integrator={"max_depth": 1})
    lights = shot.image.amax(-1) > 0
    unlit = torch.nn.functional.max_pool2d(lights.float()[None], 3 * FINE, FINE, FINE)[0] == 0
    names = enumerate(veach.description.shapes, 1)
    pixels = {name: (coarse(shot.layers["object_id"] == k, FINE)[..., 0] == 1) & unlit for k, name in names}
    return {name: on for name, on in pixels.items() if bool(on.any())} | {"all": unlit}


@pytest.mark.parametrize("spp", [16, pytest.param(64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.slow
def test_every_strategy_has_the_same_mean(veach, reference, shapes, strategy, spp):
    film = {**film_of(FINE * WIDTH, FINE * HEIGHT), "aovs": ["variance"]}
    shot = shoot(veach, spp, 3, "sobol", {"strategy": strategy}, film)
    image, variance = coarse(shot.image, FINE), coarse(shot.layers["variance"], FINE) / FINE**2
    compared = [name for name in shapes if name not in (*HOPELESS[strategy], *(("all",) if HOPELESS[strategy] else ()))]
    assert len(compared) >= 5
    for name in compared:
        on = shapes[name]
        total, error = reference[0][on].sum(0), (variance + reference[1])[on].sum(0).sqrt()
        difference = (image - reference[0])[on].sum(0)
        assert (error < 0.15 * total).all(), name
        # All channels are as good as one: the light is white.
        assert (difference.abs() < 1.25 * z_limit(len(compared)) * error).all(), (name, difference / error)


@pytest.mark.slow
def test_mis_has_the_lowest_error(veach, reference, shapes):
    seen = shapes["all"][..., None]
    errors = {}
    for strategy in STRATEGIES:
        pictures = [
            shoot(veach, 16, seed, "sobol", {"strategy": strategy}, film_of(WIDTH, HEIGHT)).image for seed in range(8)
        ]
        errors[strategy] = [float(relmse(picture * seen, reference[0] * seen)) for picture in pictures]
    for other in ("bsdf", "light"):
        assert max(errors["mis"]) < min(errors[other]), errors
